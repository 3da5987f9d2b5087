"""The twin: a known course becomes the obspy Stream that a station would have recorded (always called
simulated).

`ship` is what a ship emits and where it goes, `propagation` carries it along every path with its Doppler,
phase and dipole, `sea` and `transients` add what else is heard, `instrument` turns pascals and metres per
second into counts, `station` puts them together. Every signal is a function of absolute time and a seed, so
that a record does not depend on where it is cut.
"""
