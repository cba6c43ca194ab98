"""Types hash as ROS 2 hashes them, messages are its bytes, and hypotheses survive the way there and back."""

import struct

import numpy as np
import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from node.ros.foreign_types import MESSAGES, SERVICES
from node.ros.messages import (
    FOLDER,
    HYPOTHESES,
    NEXT_VIEW,
    QUERY_REGION,
    decode,
    encode,
    header,
    hypotheses_from,
    hypotheses_message,
    make,
    matrix,
    pose,
    register_service,
    type_hash,
    types,
)
from tests.node.peer import ADD, ADD_TEXT
from tests.node.shapes import body_with_handle

PARTS = [f"{s}_{part}" for s in (QUERY_REGION, NEXT_VIEW, *SERVICES) for part in ("Request", "Response")]
SENT = (
    "sensor_msgs/msg/PointCloud2",
    "sensor_msgs/msg/Image",
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/CameraInfo",
    "visualization_msgs/msg/MarkerArray",
    "diagnostic_msgs/msg/DiagnosticArray",
    "tf2_msgs/msg/TFMessage",
)
# As ROS 2's own generator (rosidl) writes them into packages that were built from the .msg files.
BUILT = {
    "moveit_msgs/msg/PlanningScene": "0f58540ad5eab4b9ea827d53b763c793d8cabd202b3b301fcee25afa4ce1bd80",
    "moveit_msgs/msg/CollisionObject": "74b0acd6d56be032bf4f764b2c2633f50588b5fb2bd71e97206c59052747cf7e",
    "octomap_msgs/msg/Octomap": "9891a19a05b70ec20aa8f45db3f8300b9ab80afff32c61c549d25087da9625b0",
    "vision_msgs/msg/Detection2DArray": "214274120007f4a683866481336b70310268cfa107aebe9d594a6acf75bda968",
    "vision_msgs/msg/Detection3DArray": "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
}


def test_hashes_known_from_ros() -> None:
    assert type_hash(ADD) == "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
    string = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    assert type_hash("std_msgs/msg/String") == string
    services = {
        "rcl_interfaces/srv/GetParameters": "bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
        "rcl_interfaces/srv/GetParameterTypes": "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
        "rcl_interfaces/srv/ListParameters": "3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
        "rcl_interfaces/srv/DescribeParameters": "845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
        "rcl_interfaces/srv/SetParameters": "56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
        "rcl_interfaces/srv/SetParametersAtomically": (
            "0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd"
        ),
        "type_description_interfaces/srv/GetTypeDescription": (
            "69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"
        ),
    }
    for kind, digest in (BUILT | services).items():
        assert type_hash(kind) == f"RIHS01_{digest}"
    with pytest.raises(ValueError, match="the type 'std_msgs/msg/Strin' is unknown"):
        type_hash("std_msgs/msg/Strin")


@pytest.mark.parametrize("distribution", ["kilted", "lyrical"])
def test_newer_distributions_hash_as_this_node_does(distribution: str) -> None:
    """Of all packages of ROS 2 whose types are sent, taken or part of what is: nodes of both hear each other."""
    theirs, packages = get_typestore(Stores(f"ros2_{distribution}")), {kind.split("/")[0] for kind in SENT}
    packages |= {"builtin_interfaces", "geometry_msgs", "rcl_interfaces", "rosgraph_msgs", "shape_msgs", "std_msgs"}
    packages |= {"trajectory_msgs", "type_description_interfaces"}
    shared = [kind for kind in types().fielddefs.keys() & theirs.fielddefs.keys() if kind.split("/")[0] in packages]
    assert set(SENT) <= set(shared) and len(shared) > 120
    for kind in set(shared) - {"std_msgs/msg/Char"}:  # which rosbags hashes wrongly
        assert type_hash(kind) == theirs.hash_rihs01(kind), kind


@pytest.mark.parametrize("kind", SENT)
def test_mending_changes_no_type_without_char(kind: str) -> None:
    assert type_hash(kind) == get_typestore(Stores.ROS2_JAZZY).hash_rihs01(kind)


def test_char_is_hashed_as_uint8() -> None:
    plain = get_typestore(Stores.ROS2_JAZZY)
    plain.register(get_types_from_msg("uint8 data\n", "std_msgs/msg/Twin"))
    twin = plain.hash_rihs01("std_msgs/msg/Twin")
    plain.fielddefs["std_msgs/msg/Char"] = plain.fielddefs["std_msgs/msg/Twin"]
    assert plain.hash_rihs01("std_msgs/msg/Char") != twin  # the type's name is hashed, too
    assert type_hash("std_msgs/msg/Char") == plain.hash_rihs01("std_msgs/msg/Char")


def test_our_types_are_those_of_the_files() -> None:
    """The package lists every file, and a plain typestore gives the message's hash."""
    cmake = (FOLDER / "CMakeLists.txt").read_text()
    for path in (*FOLDER.glob("msg/*"), *FOLDER.glob("srv/*")):
        assert f'"{path.parent.name}/{path.name}"' in cmake
    plain = get_typestore(Stores.ROS2_JAZZY)
    text = (FOLDER / "msg" / "ShapeHypotheses.msg").read_text()
    plain.register(get_types_from_msg(text, HYPOTHESES))
    assert type_hash(HYPOTHESES) == plain.hash_rihs01(HYPOTHESES)
    for service in (QUERY_REGION, NEXT_VIEW):
        assert [name for name, _ in types().fielddefs[service][1]] == [
            "request_message",
            "response_message",
            "event_message",
        ]
        assert types().fielddefs[f"{service}_Response"][1][0][0] == "success"


@pytest.fixture(scope="module", autouse=True)
def services() -> None:
    register_service(ADD, ADD_TEXT)


@pytest.mark.parametrize("kind", [*SENT, HYPOTHESES, *MESSAGES, *PARTS])
def test_an_empty_message_comes_back(kind: str) -> None:
    data = encode(make(kind))
    assert data[:4] == b"\x00\x01\x00\x00"  # CDR, little-endian
    assert encode(decode(bytes(data), kind)) == data
    assert data == types().serialize_cdr(make(kind), kind)


def test_bytes_are_those_of_cdr() -> None:
    """Worked by hand: alignment to four bytes, texts with their length and a zero at the end."""
    by_hand = struct.pack("<iII3sx", 7, 9, 3, b"ab\0")
    assert bytes(encode(header(7_000_000_009, "ab"))) == b"\x00\x01\x00\x00" + by_hand[:15]
    assert bytes(encode(make("std_msgs/msg/Empty"))) == b"\x00\x01\x00\x00\x00"
    assert decode(b"\x00\x01\x00\x00\x00", "std_msgs/msg/Empty") == make("std_msgs/msg/Empty")


def test_a_message_says_by_which_method_and_how_well_it_explains() -> None:
    message = hypotheses_message(body_with_handle(), "tempered_smc")
    assert message.method == "tempered_smc" and message.explained == 0.93


def test_hypotheses_that_do_not_fit_are_refused() -> None:
    message = hypotheses_message(body_with_handle())
    message.opacity = message.opacity[:-1]
    with pytest.raises(ValueError, match="opacity has 65535 entries; 2 hypotheses of 32 voxels a side need 65536"):
        hypotheses_from(message)
    message = hypotheses_message(body_with_handle())
    message.pose.orientation.w += 0.5
    with pytest.raises(ValueError, match="quaternion"):
        hypotheses_from(message)


@pytest.mark.parametrize("cut", [0, 3, 4, 20, 60, -1])
def test_bytes_cut_short_are_refused(cut: int) -> None:
    data = bytes(encode(hypotheses_message(body_with_handle())))
    with pytest.raises(ValueError, match="bytes are no farside_msgs/msg/ShapeHypotheses"):
        decode(data[:cut], HYPOTHESES)


def test_random_bytes_are_refused_or_read() -> None:
    """Whatever comes, there is a message or one kind of error."""
    rng = np.random.default_rng(0)
    refused = 0
    for _ in range(300):
        data = b"\x00\x01\x00\x00" + rng.integers(0, 256, int(rng.integers(0, 200)), dtype=np.uint8).tobytes()
        for kind in ("sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", f"{QUERY_REGION}_Request"):
            try:
                decode(data, kind)
            except ValueError:
                refused += 1
    assert refused > 500


def test_make_names_a_field_that_is_not_there() -> None:
    with pytest.raises(ValueError, match="std_msgs/msg/String has no field text; it has data"):
        make("std_msgs/msg/String", text="a")


def test_a_pose_turns_as_its_matrix() -> None:
    h = body_with_handle()
    np.testing.assert_allclose(matrix(pose(h.object_frame.T_camera_object)), h.object_frame.T_camera_object, atol=1e-15)
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]  # about z, by ROS: (0, 0, sin 45, cos 45)
    q = pose(quarter).orientation
    np.testing.assert_allclose(np.abs([q.x, q.y, q.z, q.w]), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15)
    assert q.z * q.w > 0
