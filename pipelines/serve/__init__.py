"""A finished run in the browser, on this machine only: the report, and its panoramas as a picture that zooms deep.

`tiles` (the panorama in pieces), `answers` (what a point of it is, which frames see it), `server` (addresses and
nothing but them; no path of a request ever becomes a path of the disk), `viewer/` (the page: our own, no library).
"""
