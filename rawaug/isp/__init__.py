"""The camera: stages, dictionaries, the model and its fit."""
