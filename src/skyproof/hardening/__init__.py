"""Hardening: trains a detector further, so that it withstands attacks. Nothing else imports it."""
