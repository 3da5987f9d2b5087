"""The twin: a known course becomes the obspy Stream that a station would have recorded (always called
simulated).

`ship` is what a ship emits and `course` where it goes; `propagate` carries it along every path with its
Doppler, phase and dipole; `sea`, `whales` and `seafloor` add what else is heard; `instrument` and `faults`
turn pascals and metres per second into counts and gaps; `scenario` draws or collects all of it, and `station`
makes the record, `truth` what is known of it, `files` what is kept. Every signal is a function of absolute
time and a seed, so that a record does not depend on where it is cut.
"""
