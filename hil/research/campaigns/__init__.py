"""Campaigns: thousands of flights over sampled parameters and faults, and the causes of failures."""
