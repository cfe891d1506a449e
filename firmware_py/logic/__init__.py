"""The user's own logic in the flight core: a control law, an estimator. docs/howto/own-logic.md shows how it is written."""
