"""Write and read files of other tools: CCSDS messages, SPICE kernels, tables."""
