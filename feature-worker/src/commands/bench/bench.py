"""The colour pipeline written straightforwardly with Python's OpenCV: crop, HSV, range, opening, largest contour, outer edge,
robust line, triangle. Prints the median time of a frame in microseconds. Argument: directory with task.json and frames.bgr."""
import json
import sys
import time

import cv2
import numpy as np

cv2.setNumThreads(1)
task = json.load(open(sys.argv[1] + "/task.json"))
width, height = task["width"], task["height"]
frames = np.fromfile(sys.argv[1] + "/frames.bgr", np.uint8).reshape(-1, height, width, 3)
left, top, w, h = task["region"]
low, high = np.array(task["hsv"][:3]), np.array(task["hsv"][3:])
a, b = np.array(task["x_axis"], float), np.array(task["y_axis"], float)
ex, ey = a[2:] - a[:2], b[2:] - b[:2]
ex, ey = ex / np.linalg.norm(ex), ey / np.linalg.norm(ey)
lip = a[:2] + ex * np.linalg.solve(np.stack([ex, -ey], 1), b[:2] - a[:2])[0] - (left, top)
axes = np.linalg.inv(np.stack([ex, ey], 1))
kernel = np.ones((3, 3), np.uint8)
wedge = np.zeros((h, w), np.uint8)
cv2.fillConvexPoly(wedge, np.int32([lip, lip + 2000 * ex, lip + 2000 * (ex + ey), lip + 2000 * ey]), 255)


def measure(frame):
    crop = frame[top : top + h, left : left + w]
    mask = cv2.inRange(cv2.cvtColor(crop, cv2.COLOR_BGR2HSV), low, high) & wedge
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel)
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not contours:
        return 0.0
    points = max(contours, key=cv2.contourArea)[:, 0, :]
    uw = (points - lip) @ axes.T
    edge = points[(uw[:, 0] > 2) & (uw[:, 1] > 2)]
    if len(edge) < 8:
        return 0.0
    vx, vy, x, y = cv2.fitLine(edge, cv2.DIST_HUBER, 0, 0.01, 0.01).ravel()
    cut = lambda axis: np.linalg.solve(np.array([[axis[0], -vx], [axis[1], -vy]]), np.array([x, y]) - lip)[0]
    return 0.5 * abs(cut(ex) * cut(ey) * (ex[0] * ey[1] - ex[1] * ey[0]))


times = []
for i in range(task["frames"] + len(frames)):
    start = time.perf_counter_ns()
    measure(frames[i % len(frames)])
    if i >= len(frames):
        times.append(time.perf_counter_ns() - start)
print(np.median(times) / 1e3)
