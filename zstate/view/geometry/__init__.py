"""What is drawn, made ready for a browser: surfaces of files and primitives, as binary glTF."""
