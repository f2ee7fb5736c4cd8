"""From what is known of a body to numbers: catalogue, ephemeris, shape, kernels, gravity files."""
