"""What a report shows: quantities of plans and their flights, and how numbers and colours are given."""
