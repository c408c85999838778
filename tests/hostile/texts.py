"""Contents of small, good files of the datasets and of a study."""

import json

ASF = """:units
  length 0.5
  angle deg
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 0 0 0
  orientation 0 0 0
:bonedata
  begin
    id 1
    name upper
    direction 1 0 0
    length 2
    axis 0 0 0 XYZ
    dof rz
  end
:hierarchy
  begin
    root upper
  end
"""
AMC = ":FULLY-SPECIFIED\n:DEGREES\n" + "".join(f"{frame}\nroot 0 0 0 0 0 {frame}\nupper 1.5\n" for frame in range(1, 4))
TRACKS = "".join(f"{frame} 4 {frame / 5:g} 50\n{frame} 2 {frame / 4:g} 40\n" for frame in range(780, 840, 10))
ANNOTATIONS = "".join(f'4 98 47 102 53 {frame} 0 0 0 "Pedestrian"\n' for frame in (0, 12, 24, 36))
SCALES = "quad:\n   video0:\n      scale: 0.5   # metres per pixel\n      certainty: 1.0\n"
TRACKS_CSV = (
    "recordingId,trackId,frame,xCenter,yCenter,heading,width,length,xVelocity,yVelocity,lonAcceleration,"
    "latAcceleration\n"
) + "".join(f"0,1,{frame},{frame},0,0,2,4,1,0,0,0\n" for frame in range(0, 30, 5))
TRACKS_META_CSV = "recordingId,trackId,class\n0,1,car\n"
RECORDING_META_CSV = "recordingId,locationId,frameRate\n0,3,25\n"


def score(frames: int) -> str:
    """Returns a possession of NBA tracking data."""
    lines = []
    for frame in range(0, 12 * frames, 12):
        lines.append(f"{frame} -1 {frame % 90} 25 BALL")
        lines += [f"{frame} {player} {player} 20 PLAYER" for player in range(1, 11)]
    return "\n".join(lines) + "\n"


SCORE = score(5)
SPORTVU = json.dumps(
    {
        "events": [
            {
                "moments": [
                    [1, 1000 + 40 * step, 700.0, 20.0, None]
                    + [
                        [[-1, -1, 40.0, 25.0, 3.0]]
                        + [[1 + player // 5, 1 + player, player, 20.0, 0.0] for player in range(10)]
                    ]
                    for step in range(12)
                ]
            }
        ]
    }
)
STUDY = """title = "Mine"
arms = ["none", "forecast"]
seeds = 2

[scenarios.highway-fast-v0]
steps = 100
"""
