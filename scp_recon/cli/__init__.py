"""Parse the commands, run them, and show their results and exit statuses."""
