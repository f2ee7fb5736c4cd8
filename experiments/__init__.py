"""Run the studies: each module runs by itself and writes tables to a folder."""
