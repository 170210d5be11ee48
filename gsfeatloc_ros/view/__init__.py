"""A page in the browser to look at a map, at answers in it, and to say where it lies: docs/tools.md."""
