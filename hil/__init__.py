"""The world around the board and the bench that joins them: plant, tunnel, sensors, links, harness, experiments."""
