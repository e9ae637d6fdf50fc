"""Corrections by the user, and the audit of single clusters."""
