"""Sound in a horizontally layered ocean: sound speed, bottom reflection, the delay, pressure and slowness of
each path.

In: a sound-speed profile (`sound_speed`), a station depth and a `bottom`. Out: a propagation table (`rays`),
and the observed strength of each pair of paths against range (`amplitudes`).
"""
