"""The main job: clip in; camera log, homographies, panorama and report out."""
