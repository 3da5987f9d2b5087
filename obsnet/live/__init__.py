"""The unattended station: waveforms as they come in; rows, live estimates and finished tracks out, through any failure."""
