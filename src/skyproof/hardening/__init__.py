"""Trains a detector further, so that it withstands attacks. No other package imports this one."""
