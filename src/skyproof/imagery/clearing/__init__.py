"""Finds and masks vehicles on tiles, fills in ground and checks it. A person sees the result."""
