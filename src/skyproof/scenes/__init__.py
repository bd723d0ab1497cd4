"""Scenes as plain data (where, when, how many, which vehicle), their sampling, and the backgrounds under them."""
