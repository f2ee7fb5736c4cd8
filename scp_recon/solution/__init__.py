"""The solution file, and how a plan becomes one."""
