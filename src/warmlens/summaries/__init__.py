"""Summary statistics of scan maps, each of one map or of many at once.

`correlation`: C(dr) of Delta R (Birrer+2017 sec. 4.2); `cumulative`: N(< Delta R) (sec. 5) and counts;
`response`: mean z^2 and correlation of the amplitude, which are not in the paper.
`stages/summaries.py` takes them of each band and of the maps summed over the bands.
"""
