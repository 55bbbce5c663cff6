"""The product: RAW pairs from the pictures of any Dataset or DataLoader."""
