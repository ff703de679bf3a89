"""Synthetic tomography experiments with a known truth: analytic specimen, motion, X-rays, detector."""
