"""From flight data to the model's constants."""
