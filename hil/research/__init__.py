"""Answers questions with many flights or none: campaigns, design, identification, studies, learning; commands call it."""
