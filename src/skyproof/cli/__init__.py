"""The single commands: each a frozen dataclass of settings with `run()`, for people and for plans.

Only this package prints and picks a device. A command imports what it uses when it runs.
"""
