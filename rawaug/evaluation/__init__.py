"""Scores of ISPs and denoisers, and the tables and pages that show them."""
