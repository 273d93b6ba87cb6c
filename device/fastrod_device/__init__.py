"""The prototype: motors, camera and their emulator."""
