"""Synthetic tomography experiments with a known truth: analytic specimen, motion, X-rays, detector."""

from pdvc_bench import check_extra, check_namesakes

check_namesakes("pdvc")
check_extra("simulate", "trimesh", "xraylib")
