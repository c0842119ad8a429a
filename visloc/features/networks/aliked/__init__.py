"""ALIKED."""
