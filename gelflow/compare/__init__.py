"""Scoring methods on the same image pairs, and reporting the comparison as tables, plots, CSV and JSON."""
