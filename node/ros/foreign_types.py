"""Types of other ROS 2 packages of which rosbags has no text, by their fields, each after those that it is made of.

Comments, constants and default values are left out: neither the bytes nor a type's hash depend on them.
"""

# MoveIt 2, octomap_msgs, object_recognition_msgs and vision_msgs 4 are the same in Jazzy, Kilted and Rolling.
MESSAGES = {
    "object_recognition_msgs/msg/ObjectType": "string key\nstring db\n",
    "octomap_msgs/msg/Octomap": "std_msgs/Header header\nbool binary\nstring id\nfloat64 resolution\nint8[] data\n",
    "octomap_msgs/msg/OctomapWithPose": (
        "std_msgs/Header header\ngeometry_msgs/Pose origin\noctomap_msgs/Octomap octomap\n"
    ),
    "moveit_msgs/msg/CollisionObject": (
        "std_msgs/Header header\ngeometry_msgs/Pose pose\nstring id\nobject_recognition_msgs/ObjectType type\n"
        "shape_msgs/SolidPrimitive[] primitives\ngeometry_msgs/Pose[] primitive_poses\n"
        "shape_msgs/Mesh[] meshes\ngeometry_msgs/Pose[] mesh_poses\n"
        "shape_msgs/Plane[] planes\ngeometry_msgs/Pose[] plane_poses\n"
        "string[] subframe_names\ngeometry_msgs/Pose[] subframe_poses\nbyte operation\n"
    ),
    "moveit_msgs/msg/AttachedCollisionObject": (
        "string link_name\nCollisionObject object\nstring[] touch_links\n"
        "trajectory_msgs/JointTrajectory detach_posture\nfloat64 weight\n"
    ),
    "moveit_msgs/msg/RobotState": (
        "sensor_msgs/JointState joint_state\nsensor_msgs/MultiDOFJointState multi_dof_joint_state\n"
        "AttachedCollisionObject[] attached_collision_objects\nbool is_diff\n"
    ),
    "moveit_msgs/msg/AllowedCollisionEntry": "bool[] enabled\n",
    "moveit_msgs/msg/AllowedCollisionMatrix": (
        "string[] entry_names\nAllowedCollisionEntry[] entry_values\n"
        "string[] default_entry_names\nbool[] default_entry_values\n"
    ),
    "moveit_msgs/msg/LinkPadding": "string link_name\nfloat64 padding\n",
    "moveit_msgs/msg/LinkScale": "string link_name\nfloat64 scale\n",
    "moveit_msgs/msg/ObjectColor": "string id\nstd_msgs/ColorRGBA color\n",
    "moveit_msgs/msg/PlanningSceneWorld": (
        "CollisionObject[] collision_objects\noctomap_msgs/OctomapWithPose octomap\n"
    ),
    "moveit_msgs/msg/PlanningScene": (
        "string name\nRobotState robot_state\nstring robot_model_name\n"
        "geometry_msgs/TransformStamped[] fixed_frame_transforms\n"
        "AllowedCollisionMatrix allowed_collision_matrix\nLinkPadding[] link_padding\nLinkScale[] link_scale\n"
        "ObjectColor[] object_colors\nPlanningSceneWorld world\nbool is_diff\n"
    ),
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": (
        "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
    ),
    "vision_msgs/msg/Point2D": "float64 x\nfloat64 y\n",
    "vision_msgs/msg/Pose2D": "vision_msgs/Point2D position\nfloat64 theta\n",
    "vision_msgs/msg/BoundingBox2D": "vision_msgs/Pose2D center\nfloat64 size_x\nfloat64 size_y\n",
    "vision_msgs/msg/Detection2D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox2D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection2DArray": "std_msgs/Header header\nDetection2D[] detections\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}
# By request and response, as in a .srv file.
SERVICES = {
    # of every node of ROS 2
    "rcl_interfaces/srv/GetParameters": "string[] names\n---\nrcl_interfaces/ParameterValue[] values\n",
    "rcl_interfaces/srv/GetParameterTypes": "string[] names\n---\nuint8[] types\n",
    "rcl_interfaces/srv/ListParameters": (
        "string[] prefixes\nuint64 depth\n---\nrcl_interfaces/ListParametersResult result\n"
    ),
    "rcl_interfaces/srv/DescribeParameters": (
        "string[] names\n---\nrcl_interfaces/ParameterDescriptor[] descriptors\n"
    ),
    "rcl_interfaces/srv/SetParameters": (
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult[] results\n"
    ),
    "rcl_interfaces/srv/SetParametersAtomically": (
        "rcl_interfaces/Parameter[] parameters\n---\nrcl_interfaces/SetParametersResult result\n"
    ),
    "type_description_interfaces/srv/GetTypeDescription": (
        "string type_name\nstring type_hash\nbool include_type_sources true\n---\n"
        "bool successful\nstring failure_reason\ntype_description_interfaces/TypeDescription type_description\n"
        "type_description_interfaces/TypeSource[] type_sources\n"
        "type_description_interfaces/KeyValue[] extra_information\n"
    ),
    # Isaac ROS 4 (Jazzy); in 3.2 (Humble) the response has no header
    "nvblox_msgs/srv/EsdfAndGradients": (
        "bool update_esdf\nbool visualize_esdf\nbool use_aabb\nstring frame_id\n"
        "geometry_msgs/Point aabb_min_m\ngeometry_msgs/Vector3 aabb_size_m\n"
        "geometry_msgs/Point[] aabbs_to_clear_min_m\ngeometry_msgs/Vector3[] aabbs_to_clear_size_m\n"
        "geometry_msgs/Point[] spheres_to_clear_center_m\nfloat32[] spheres_to_clear_radius_m\n---\n"
        "std_msgs/Header header\ngeometry_msgs/Point origin_m\nfloat32 voxel_size_m\n"
        "std_msgs/Float32MultiArray esdf_and_gradients\nbool success\n"
    ),
}
