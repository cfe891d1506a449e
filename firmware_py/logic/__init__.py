"""The user's own logic in the flight core: a control law, an estimator. See docs/howto/own-logic.md."""
