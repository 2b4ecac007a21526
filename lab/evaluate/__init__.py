"""Measures accuracy, speed and size of many runs, a row each, and draws charts from the rows alone.

Read in this order: variants (of the published method), cells (the grid of runs), sources (clips by name), ranking (does
confidence rank the errors), truth (scores that need synthetic clips), right_eye (scores of a recorded right eye),
thinned (fewer pixels for methods that render ray by ray), measure (a cell becomes a row), rows (the CSV files), summary
(medians, and claims computed from them), published (figures of papers), charts, command.
"""
