"""Observer of the public board in Python: tracks of points in clutter by the nearest neighbor and an alpha-beta filter.

servotrack submit --suite 2027a-clutter --command "python observer.py" --name my-observer
"""

import json
import math
import sys

GATE, ALPHA, BETA = 60.0, 0.7, 0.3
CONFIRMED, LOST = 3, 3


def positions(scan, sensor):
    """Return the measurements of a scan as points, m. A radar gives range (m) and bearing (rad) from its sensor."""
    seen = [row[1:] for row in scan if row[0] == 1.0]
    if sensor is None:
        return seen
    return [[sensor[0] + r * math.cos(b), sensor[1] + r * math.sin(b)] for r, b in seen]


def update(tracks, points):
    """Move all tracks by one scan, give each the nearest point within the gate, and start tracks at the other points.

    A track keeps its place in the list, for the row of an answer is the identity. None marks a free row.
    """
    for track in filter(None, tracks):
        track["at"] = [track["at"][axis] + track["speed"][axis] for axis in range(2)]
    pairs = sorted(
        (math.dist(track["at"], point), k, j)
        for k, track in enumerate(tracks)
        if track is not None
        for j, point in enumerate(points)
    )
    fed, used = set(), set()
    for distance, k, j in pairs:
        # The speed of a new track is unknown.
        if distance < GATE * (2 if tracks[k]["hits"] == 1 else 1) and k not in fed and j not in used:
            fed.add(k)
            used.add(j)
            correct(tracks[k], points[j])
    for k, track in enumerate(tracks):
        if track is not None and k not in fed:
            track["misses"] += 1
            if track["misses"] >= (LOST if track["hits"] >= CONFIRMED else 1):
                tracks[k] = None
    for j, point in enumerate(points):
        if j not in used and None in tracks:
            tracks[tracks.index(None)] = {"at": list(point), "speed": [0.0, 0.0], "hits": 1, "misses": 0}


def correct(track, point):
    """Correct position and speed by a measurement."""
    first = track["hits"] == 1
    for axis in range(2):
        miss = point[axis] - track["at"][axis]
        track["at"][axis] += (1.0 if first else ALPHA) * miss
        track["speed"][axis] += (1.0 if first else BETA) * miss
    track["hits"], track["misses"] = track["hits"] + 1, 0


def answer(tracks):
    """Return one row per track: existence probability, x and y. Below 0.5 a target is not reported yet."""
    return [
        [0.0, 0.0, 0.0] if track is None else [0.9 if track["hits"] >= CONFIRMED else 0.2, *track["at"]]
        for track in tracks
    ]


def main():
    """Answer every observation with one line."""
    tracks, rows, sensor = [], 0, None
    for line in sys.stdin:
        message = json.loads(line)
        if message["message"] == "environment":
            rows, sensor = len(message["low"]), message["scene_model"]["model"].get("sensor")
        elif message["message"] == "end":
            return
        else:
            if message["message"] == "reset":
                tracks = [None] * rows
            update(tracks, positions(message["observation"], sensor))
            print(json.dumps(answer(tracks)), flush=True)


if __name__ == "__main__":
    main()
