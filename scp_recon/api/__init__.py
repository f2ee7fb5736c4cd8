"""One function for each verb of scripts and commands, in SI; `import scp_recon as sr` has them by name.

Each verb's options are checked once, here. Paths may be strings. A plan may be its solution, or its
file or folder. Nothing is imported here, so that a command imports only what it does.
"""
