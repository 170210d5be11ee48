"""What is in a map, and what of it looks wrong for localization: text, JSON, a page."""
