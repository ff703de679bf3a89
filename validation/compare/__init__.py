"""Comparisons: several methods measure the same experiments."""
