"""The links from the ground station to the board. Each encodes poses and goals and decodes telemetry in its own
protocol.
"""
