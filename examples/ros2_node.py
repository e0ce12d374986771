"""A ROS 2 node: images of a gel come in on image_raw, flow (32FC2, px) and sigma (32FC1, px) go out with their stamps.

python examples/ros2_node.py --ros-args -r image_raw:=/camera/image_raw

The first image is the reference; a message on reset makes the next one the reference.
"""

import numpy as np

import gelflow


def pixels(message):
    """The image of a sensor_msgs/Image, (H, W, 3) uint8, of rgb8, bgr8 or mono8."""
    channels = 1 if message.encoding == "mono8" else 3
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    image = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    return image[..., ::-1] if message.encoding == "bgr8" else image.repeat(3 // channels, axis=2)


def fill(message, header, field):
    """A field (H, W, C) float32 as a sensor_msgs/Image."""
    field = np.ascontiguousarray(field, np.float32)
    message.header, message.encoding = header, f"32FC{field.shape[2]}"
    message.height, message.width, message.step = *field.shape[:2], field[0].nbytes
    message.data = field.tobytes()
    return message


def main():
    import rclpy
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image
    from std_msgs.msg import Empty

    rclpy.init()
    newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)  # leave images out rather than be late
    node, tracker = rclpy.create_node("gelflow"), None
    topics = {name: node.create_publisher(Image, name, newest) for name in ("flow", "sigma")}

    def forget(_):
        nonlocal tracker
        tracker = None

    def update(message):
        nonlocal tracker
        if tracker is None:
            tracker = gelflow.Tracker(pixels(message), wait=False)
            return
        found = tracker.update(pixels(message))
        for name, field in (("flow", found.flow), ("sigma", found.sigma[..., None])):
            topics[name].publish(fill(Image(), message.header, field))

    node.create_subscription(Image, "image_raw", update, newest)
    node.create_subscription(Empty, "reset", forget, 1)
    rclpy.spin(node)


if __name__ == "__main__":
    main()
