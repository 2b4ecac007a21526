"""How good, how soon, how small: many runs measured the same way, a row each, and charts drawn from the rows alone.

Read in this order: variants (of the published method), cells (what is measured), sources (what a clip's name means),
ranking (does confidence rank the errors), truth (what only synthetic clips can tell), right_eye (what a recorded right
eye can), rivals (systems of others), thinned (what draws ray by ray is scored at some of the pixels), measure (one cell
becomes a row), rows (the CSV files), summary (medians, and the claims made of them), published (what papers print),
charts, command.
"""
