"""Effects that a scene can name: departures from a matte object, even light and a perfect sensor.

Effects of one base class change the same thing in turn; `frames.Simulation` applies the others where they act.
`scene.EFFECTS` lists all in the order in which they act. A scene without effects runs no code of any.
"""
