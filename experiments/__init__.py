"""Run the studies: each module runs by itself and writes tables to a folder.

`harness` runs a study; `evidence`, `sentinels`, `pages` and `renewal` keep the figures of the pages.
Benchmarks and tests alone may import this folder; it imports what a user of `scp_recon` may, and below.
"""
