// What every dataset asks of its poses and cameras before it believes them.
#pragma once

#include <span>
#include <string>

#include "scene/scene.h"

namespace semfield {

/// "frame 'rgb_12' (/data/room/rgb/rgb_12.png)": how every message names a frame.
std::string frame_place(const FrameInfo& frame);

/// From row-major numbers: 16 (4 x 4) or 12 (3 x 4), world from camera.
Pose pose_from_rows(std::span<const double> numbers);
/// The same pose with OpenGL camera axes (x right, y up, z backward) turned into OpenCV ones (x right, y down, z
/// forward).
Pose opencv_from_opengl(Pose pose);

/// Of 16 numbers: reports a fourth row that is finite and not 0 0 0 1.
bool check_last_row(std::span<const double> numbers, const std::string& place, Diagnostics& diagnostics);

enum class PoseState { good, not_finite, refused };

/// Rotation part: an error above 1e-3 off orthonormal or with determinant -1 is reported as an error; above 1e-5 as a
/// warning; rounded digits (above 1e-9) are made orthonormal. A pose with NaN or infinity is only told, never reported:
/// the dataset skips and counts it.
PoseState check_pose(Pose& pose, const std::string& place, Diagnostics& diagnostics);

/// Counts what check_pose called not_finite; one warning that names up to eight of them, and an error when no frame is
/// left.
void report_skipped(const std::vector<std::string>& skipped, std::size_t kept, const std::string& source,
                    Diagnostics& diagnostics);

/// Every number of a manifest that becomes a ray: poses, bounds and near and far hints must be finite, cameras as
/// check_camera wants them, whatever dataset told them. Frames that `diagnostics` names already are passed over.
void check_manifest_numbers(const SceneInfo& info, Diagnostics& diagnostics);
/// Warns of frames that share one pose.
void check_poses_differ(const SceneInfo& info, Diagnostics& diagnostics);

/// Focal lengths positive, principal point at most one image size outside, lens invertible over the image (else a
/// warning: the pixels beyond are masked; an error where it is so about the middle too). A lens that bends rays to a
/// tenth or ten times their angle is an error, to half or twice a warning. False when an error was reported.
bool check_camera(const Camera& camera, const std::string& place, Diagnostics& diagnostics);

/// For intrinsics that a file states apart from the images, of a camera with a size: reports a principal point that is
/// the middle of a picture of another size, with the factor, or of one turned by a quarter. False when it did.
bool check_principal_point(const Camera& camera, const std::string& place, Diagnostics& diagnostics);

}  // namespace semfield
