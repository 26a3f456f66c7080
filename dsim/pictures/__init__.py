"""All drawing.  matplotlib lives here and nowhere below; this root imports nothing, to start quickly."""
