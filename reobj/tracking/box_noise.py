"""Noise of the constant-velocity model of boxes, for the online filter and the smoother.

Standard deviations, relative to the size of the box (DeepSORT: 1/20, 1/160, 1/20, 1/16).
"""

STD_POSITION = 0.05  # process noise of a position, per frame
STD_VELOCITY = 1 / 80  # process noise of a velocity, per frame
STD_MEASURE = 0.05  # of a measured box (of score .8, in the online filter)
STD_START = 0.2  # of a new track's velocity
