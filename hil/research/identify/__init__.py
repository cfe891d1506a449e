"""Estimates the model's constants from flight data."""
