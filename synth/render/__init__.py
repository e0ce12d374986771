"""Images of the deformed gel: pattern, lights, path tracing, camera sensor."""
