"""Questions that many flights answer: campaigns, design, identification, studies, learning."""
