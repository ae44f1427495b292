"""Providers: who or what makes a cue (hands, tracks, masks, depth, meshes, cameras)."""
