"""The student: a scene graph network, an allocation head and a diffusion transformer that draws a whole fleet's flights."""
