"""Design whole passes for the least delta-v: burn times, and on a home orbit phases and epochs.

`design` is the loop: `scan` maps the phases, `timing` descends within `space`. The api and
the commands may import this folder; it imports `interop`, `planning` and below.
"""
