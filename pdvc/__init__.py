"""Projection-based digital volume correlation: motion of a sample from one radiograph per load step."""
