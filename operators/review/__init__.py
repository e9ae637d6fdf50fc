"""Corrections by a person, and the audit of single clusters."""
