"""Write and read files of other tools: CCSDS messages, SPICE kernels, tables.

`export` prepares, `ccsds`, `kernels` and `files` write, `tracks` and `ccsds` read. Passes, replanning
and everything above them may import this folder; it imports `verification` and below.
"""
