"""Recipes: training, evaluation and reports."""
