"""Estimating the flow of image files and videos, and drawing it."""
