"""What is done where files of trajectories leave something open: the words of options and keys."""

from typing import Literal

#: The curve between samples.
Interpolation = Literal["cubic", "linear"]
#: What a vehicle does before its first sample and after its last one, while others have samples.
Spans = Literal["refuse", "stand", "away"]
#: What a long gap between two samples of a vehicle is: an error, or time in which the curve is believed.
Gaps = Literal["refuse", "bridge"]
#: Options that say how files of positions are read, whoever reads them.
READING = "interpolation", "gaps", "units", "axes", "topic"
