"""Studies: how errors depend on chosen factors, over many simulated experiments."""
