"""The paper's comparisons: other methods, reconstruction tables and ablations; nothing of the product imports this."""
