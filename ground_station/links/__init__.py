"""The ways from the ground station to the board. Each encodes corrections and decodes telemetry in its own
protocol.
"""
