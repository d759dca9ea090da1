"""Classes, attributes, channels and evaluation ranges of MAN TruckScenes (devkit 1.2, `detection_cvpr_2024`)."""

from __future__ import annotations

CLASSES = (
    "car",
    "truck",
    "bus",
    "trailer",
    "other_vehicle",
    "pedestrian",
    "motorcycle",
    "bicycle",
    "traffic_cone",
    "barrier",
    "animal",
    "traffic_sign",
)

CLASS_RANGE_M: dict[str, float] = {
    name: 150.0 if name in ("car", "truck", "bus", "trailer", "other_vehicle") else 75.0 for name in CLASSES
}
"""A box counts if its xy distance to the ego of the LIDAR_LEFT key frame is below this."""

ATTRIBUTES = (
    "vehicle.moving",
    "vehicle.parked",
    "vehicle.stopped",
    "pedestrian.moving",
    "pedestrian.standing",
    "pedestrian.sitting_lying_down",
    "cycle.with_rider",
    "cycle.without_rider",
    "traffic_sign.pole_mounted",
    "traffic_sign.overhanging",
    "traffic_sign.temporary",
)

CLASS_ATTRIBUTE_PREFIX: dict[str, str | None] = {
    "car": "vehicle.",
    "truck": "vehicle.",
    "bus": "vehicle.",
    "trailer": "vehicle.",
    "other_vehicle": "vehicle.",
    "pedestrian": "pedestrian.",
    "motorcycle": "cycle.",
    "bicycle": "cycle.",
    "traffic_cone": None,
    "barrier": None,
    "animal": None,
    "traffic_sign": "traffic_sign.",
}
"""Which attributes a class can carry; None for none."""

CATEGORY_TO_CLASS: dict[str, str] = {
    "vehicle.car": "car",
    "vehicle.truck": "truck",
    "vehicle.bus.bendy": "bus",
    "vehicle.bus.rigid": "bus",
    "vehicle.trailer": "trailer",
    "vehicle.ego_trailer": "trailer",
    "vehicle.construction": "other_vehicle",
    "vehicle.other": "other_vehicle",
    "human.pedestrian.adult": "pedestrian",
    "human.pedestrian.child": "pedestrian",
    "human.pedestrian.construction_worker": "pedestrian",
    "human.pedestrian.police_officer": "pedestrian",
    "vehicle.motorcycle": "motorcycle",
    "vehicle.bicycle": "bicycle",
    "movable_object.trafficcone": "traffic_cone",
    "movable_object.barrier": "barrier",
    "animal": "animal",
    "static_object.traffic_sign": "traffic_sign",
}

BICYCLE_RACK = "static_object.bicycle_rack"

IGNORED_CATEGORIES = (
    "human.pedestrian.personal_mobility",
    "human.pedestrian.stroller",
    "human.pedestrian.wheelchair",
    "movable_object.debris",
    "movable_object.pushable_pullable",
    BICYCLE_RACK,
    "vehicle.emergency.ambulance",
    "vehicle.emergency.police",
    "vehicle.train",
)

SENSORS = ("camera", "radar", "lidar")
"""The kinds of sensors that a model may use."""
CAMERAS = ("CAMERA_LEFT_FRONT", "CAMERA_RIGHT_FRONT", "CAMERA_RIGHT_BACK", "CAMERA_LEFT_BACK")
RADARS = (
    "RADAR_LEFT_FRONT",
    "RADAR_RIGHT_FRONT",
    "RADAR_RIGHT_SIDE",
    "RADAR_RIGHT_BACK",
    "RADAR_LEFT_BACK",
    "RADAR_LEFT_SIDE",
)
LIDARS = ("LIDAR_LEFT", "LIDAR_RIGHT", "LIDAR_REAR", "LIDAR_TOP_FRONT", "LIDAR_TOP_LEFT", "LIDAR_TOP_RIGHT")
REFERENCE_CHANNEL = "LIDAR_LEFT"
"""Its key frame defines ego(t): the frame of all network geometry and of evaluation ranges."""

MAX_BOXES_PER_SAMPLE = 500
"""The official evaluator refuses more."""
