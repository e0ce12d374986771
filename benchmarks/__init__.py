"""Measurements of the product, one script a question."""
