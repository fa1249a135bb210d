"""ROS 2 message definitions as `ros2msg` schemas, with which any MCAP reader decodes recordings.

The public ones are reduced to their fields; those of Frame, Timing and State follow their layouts.
"""

from __future__ import annotations

from collections.abc import Mapping

_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/Bool": "bool data\n",
    "std_msgs/String": "string data\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose\n",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header "
    "header\ngeometry_msgs/PoseWithCovariance pose\n",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion "
    "rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] "
        "effort\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec\n",
    "std_msgs/ColorRGBA": "float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n",
    "sensor_msgs/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "visualization_msgs/UVCoordinate": "float32 u\nfloat32 v\n",
    "visualization_msgs/MeshFile": "string filename\nuint8[] data\n",
    "visualization_msgs/Marker": (
        "std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\ngeometry_msgs/Pose "
        "pose\n"
        "geometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\nbuiltin_interfaces/Duration "
        "lifetime\n"
        "bool frame_locked\ngeometry_msgs/Point[] points\nstd_msgs/ColorRGBA[] colors\nstring "
        "texture_resource\n"
        "sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] "
        "uv_coordinates\nstring text\n"
        "string mesh_resource\nvisualization_msgs/MeshFile mesh_file\nbool "
        "mesh_use_embedded_materials\n"
    ),
    "visualization_msgs/MarkerArray": "visualization_msgs/Marker[] markers\n",
    "thirdhand/Tick": "int64 index\nuint32 lost\nuint8[] events\n",
    "thirdhand/CheckedTick": "int64 index\nuint32 lost\nuint8[] events\nuint32 checksum\n",
    "thirdhand/Skill": "uint8[] data\n",
}


def schema(message_type: str, own: Mapping[str, str] | None = None) -> str:
    """The `ros2msg` schema of a message type like `geometry_msgs/msg/PoseStamped`, with its
    dependencies.

    `own` are the definitions of further types, as `core.frame.definitions` has them.
    """
    name = message_type.replace("/msg/", "/")
    if own and name in own:
        return own[name]
    text = _DEFINITIONS[name]
    defined = {name}
    waiting = [name]
    while waiting:
        for line in _DEFINITIONS[waiting.pop(0)].splitlines():
            needed = line.split()[0].removesuffix("[]")
            if needed in _DEFINITIONS and needed not in defined:
                defined.add(needed)
                waiting.append(needed)
                text += f"{'=' * 80}\nMSG: {needed}\n{_DEFINITIONS[needed]}"
    return text
