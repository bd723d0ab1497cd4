"""Scenes as plain data: ground, light, and the choice of vehicles and their places."""
