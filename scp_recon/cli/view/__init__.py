"""What the commands show: tables in the terminal, and charts beside a plan."""
