"""Identification: the parameters of an elastoplastic law, from radiographs and the measured force.

The simulator's own beam (`simulator.loading`) is a stranger here: nothing is shared with it but the meaning of a
tensile test.
"""
