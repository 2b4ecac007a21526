"""The methods as data: all settings of training, listed in the order in which a clip meets them.

Read method (what a preset and a departure are), paper (the published method), fast (our method, as departures from
paper), then registry (presets by name). docs/method.md shows the same on one page, with figures.
"""
