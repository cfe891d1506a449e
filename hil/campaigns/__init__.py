"""Campaigns: thousands of flights over sampled parameters and faults, and what breaks the robot in them."""
