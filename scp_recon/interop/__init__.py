"""Files for other tools, and from them: CCSDS messages, SPICE kernels, tables."""
