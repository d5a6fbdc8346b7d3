"""Noise of the constant-velocity model of boxes, for the online filter and the smoother.

Standard deviations, relative to the size of the box, as in DeepSORT's filter.
"""

# of a measured box (of score .8, in the online filter), and process noise of a position, per frame
# (DeepSORT: one weight for both, 1/20)
STD_POSITION = 0.05
# process noise of a velocity, per frame (DeepSORT: 1/160; without images and poses the camera's
# motion is in it too)
STD_VELOCITY = 1 / 80
# of a new track's velocity (DeepSORT: 1/16; SORT: nearly unknown); higher: the second box of an
# object may be farther from the first, and then also be a neighbour's
STD_START = 0.2
