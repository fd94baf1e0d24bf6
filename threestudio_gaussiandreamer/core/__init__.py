"""What every ring uses: errors, random streams, files, checkpoints, schedules, images. No host, no
models.
"""
