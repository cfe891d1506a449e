"""Logic of one's own in the flight core: a control law, an estimator. docs/own-logic.md shows how it is written."""
