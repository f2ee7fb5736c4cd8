"""Offer one function for each verb of scripts and commands, in SI (`import scp_recon as sr`).

The options of each verb are checked once, here. Paths may be strings. A plan may be given as its
solution, its file or its folder. This package imports nothing, so that a command imports only the
modules that it needs.
"""
