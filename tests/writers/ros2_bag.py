"""Writes a ROS 2 bag (MCAP storage) with PyPI's rosbags, which knows nothing of Stria.

usage: ros2_bag.py IMAGES BAG_DIR [--raw ENCODING] [--odometry TRAJECTORY_CSV] [--no-tf] [--fps F] [--second-camera]

IMAGES: a folder of images, sorted by name; they are published as sensor_msgs/CompressedImage, or with --raw as
sensor_msgs/Image. The camera sits turned and shifted on the robot, as /tf_static says. Times begin at 1,700,000,000 s.
"""

import argparse
import csv
import math
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

START_NS = 1_700_000_000_000_000_000
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types


def t(name):
    return TYPES[name]


def header(time_ns, frame):
    stamp = t("builtin_interfaces/msg/Time")(sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return t("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)


def rotation(axis, angle):
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + s * k + (1 - c) * k @ k


def quaternion(r):
    w = math.sqrt(max(0.0, 1 + np.trace(r))) / 2
    if w > 1e-3:
        x, y, z = (r[2, 1] - r[1, 2]) / (4 * w), (r[0, 2] - r[2, 0]) / (4 * w), (r[1, 0] - r[0, 1]) / (4 * w)
    else:
        values, vectors = np.linalg.eigh(r + r.T)
        (x, y, z), w = vectors[:, -1], 0.0
    return t("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)


def matrix(r, p):
    m = np.eye(4)
    m[:3, :3], m[:3, 3] = r, p
    return m


# The optical frame on the robot's body: z forward is the body's left, x right is the body's forward; 0.3 m up.
BODY_FROM_CAMERA = matrix(rotation((1, 0, 0), -math.pi / 2), [0.2, 0.05, 0.3])


def camera_poses(path):
    """world_from_camera of a trajectory.csv, in metres."""
    with open(path) as file:
        for row in csv.DictReader(file):
            if not row["x_mm"]:
                continue
            roll, pitch, yaw = (math.radians(float(row[a] or 0)) for a in ("roll_deg", "pitch_deg", "yaw_deg"))
            r = rotation((0, 1, 0), yaw) @ rotation((1, 0, 0), pitch) @ rotation((0, 0, 1), roll)
            yield float(row["time_s"]), matrix(r, [float(row[a]) / 1000 for a in ("x_mm", "y_mm", "z_mm")])


def raw_image(path, encoding, time_ns):
    rgb = np.asarray(Image.open(path).convert("RGB"))
    pixels = {"rgb8": rgb, "bgr8": rgb[:, :, ::-1], "rgba8": np.dstack([rgb, np.full(rgb.shape[:2], 255, "u1")])}
    pixels = pixels[encoding]
    step = pixels.shape[1] * pixels.shape[2] + 8  # rows with room behind them
    padded = np.zeros((pixels.shape[0], step), "u1")
    padded[:, : step - 8] = pixels.reshape(pixels.shape[0], -1)
    return t("sensor_msgs/msg/Image")(
        header=header(time_ns, "camera_optical"),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=0,
        step=step,
        data=padded.ravel(),
    )


def camera_info(width, height, time_ns):
    roi = t("sensor_msgs/msg/RegionOfInterest")(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return t("sensor_msgs/msg/CameraInfo")(
        header=header(time_ns, "camera_optical"),
        height=height,
        width=width,
        distortion_model="plumb_bob",
        d=np.zeros(5),
        k=np.array([100.0, 0, width / 2, 0, 100.0, height / 2, 0, 0, 1]),
        r=np.eye(3).ravel(),
        p=np.array([100.0, 0, width / 2, 0, 0, 100.0, height / 2, 0, 0, 0, 1, 0]),
        binning_x=0,
        binning_y=0,
        roi=roi,
    )


def odometry(time_ns, pose):
    point = t("geometry_msgs/msg/Point")(x=pose[0, 3], y=pose[1, 3], z=pose[2, 3])
    vector = t("geometry_msgs/msg/Vector3")
    still = t("geometry_msgs/msg/Twist")(linear=vector(x=0.0, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0))
    return t("nav_msgs/msg/Odometry")(
        header=header(time_ns, "odom"),
        child_frame_id="base_link",
        pose=t("geometry_msgs/msg/PoseWithCovariance")(
            pose=t("geometry_msgs/msg/Pose")(position=point, orientation=quaternion(pose[:3, :3])), covariance=np.zeros(36)
        ),
        twist=t("geometry_msgs/msg/TwistWithCovariance")(twist=still, covariance=np.zeros(36)),
    )


def fixed(parent, child, m):
    p = t("geometry_msgs/msg/Vector3")(x=m[0, 3], y=m[1, 3], z=m[2, 3])
    transform = t("geometry_msgs/msg/Transform")(translation=p, rotation=quaternion(m[:3, :3]))
    return t("geometry_msgs/msg/TransformStamped")(header=header(START_NS, parent), child_frame_id=child, transform=transform)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("images", type=Path)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--raw")
    parser.add_argument("--odometry", type=Path)
    parser.add_argument("--no-tf", action="store_true")
    parser.add_argument("--second-camera", action="store_true")
    parser.add_argument("--fps", type=float, default=30.0)
    arguments = parser.parse_args()
    images = sorted(p for p in arguments.images.iterdir() if p.suffix in (".jpg", ".png"))
    messages = []
    for index, path in enumerate(images):
        time_ns = START_NS + round(index / arguments.fps * 1e9)
        if arguments.raw:
            messages.append((time_ns, "/camera/image_raw", raw_image(path, arguments.raw, time_ns)))
        else:
            image = t("sensor_msgs/msg/CompressedImage")(
                header=header(time_ns, "camera_optical"),
                format="bgr8; jpeg compressed bgr8",
                data=np.frombuffer(path.read_bytes(), "u1"),
            )
            messages.append((time_ns, "/camera/image_raw/compressed", image))
        if arguments.second_camera and index < 3:
            messages.append((time_ns + 1, "/front/image_raw", raw_image(path, "rgb8", time_ns)))
        width, height = Image.open(path).size
        messages.append((time_ns + 2, "/camera/camera_info", camera_info(width, height, time_ns)))
    if arguments.odometry:
        for time_s, world_from_camera in camera_poses(arguments.odometry):
            time_ns = START_NS + round(time_s * 1e9)
            # The odometry's own world is turned and far away: only the way counts.
            odom = matrix(rotation((0, 0, 1), 0.7), [12.0, -3.0, 0.5])
            body = odom @ world_from_camera @ np.linalg.inv(BODY_FROM_CAMERA)
            messages.append((time_ns + 3, "/odom", odometry(time_ns, body)))
    if not arguments.no_tf:
        up = matrix(np.eye(3), [0, 0, 0.1])
        links = [fixed("base_link", "mast", up), fixed("mast", "camera_optical", np.linalg.inv(up) @ BODY_FROM_CAMERA)]
        messages.append((START_NS, "/tf_static", t("tf2_msgs/msg/TFMessage")(transforms=links)))
    messages.sort(key=lambda m: m[0])
    with Writer(arguments.bag, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        connections = {}
        for time_ns, topic, message in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message.__msgtype__, typestore=STORE)
            # Recorded a moment after it was captured, as on a robot.
            data = STORE.serialize_cdr(message, message.__msgtype__)
            bag.write(connections[topic], time_ns + 4_000_000, data)


main()
