"""What is shown of a campaign: outcomes, map, globe, curves, and the page that has them."""
