"""The methods as data: all settings of training, listed in the order in which a clip meets them.

Begin with docs/method.md, one page with figures. Then read paper (the published method) and fast (ours, as departures
from paper); method says what every value means, registry finds a preset by its name.
"""
