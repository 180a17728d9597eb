// What photographs without depth say of the convention of poses: corners found again in neighbouring ones, and the
// epipolar lines where the poses put them. Unit and scale do not show in them.
#pragma once

#include <array>
#include <optional>
#include <vector>

#include "scene/bundle.h"
#include "scene/survey/depth_survey.h"
#include "scene/survey/geometry_votes.h"

namespace semfield {

/// A corner and what it looks like: 8 x 8 means of grey around it, mean 0 and length 1.
struct PhotoCorner {
  Vec3d ray;            ///< in camera axes, z = 1
  double u = 0, v = 0;  ///< in the photograph as loaded, pixels
  float grey = 0;       ///< mean around it, 0 to 255
  std::array<float, 64> patch;
};

/// What the check keeps of a photograph.
struct PhotoFrame {
  Camera camera;  ///< its focal lengths are those of the small picture
  std::vector<PhotoCorner> corners;
};

/// A small picture in grey, 0 to 255.
struct Grey {
  std::int32_t width = 0, height = 0;
  std::vector<float> value;
  float at(std::int32_t x, std::int32_t y) const {
    return value[static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x)];
  }
};
/// Pixels of a photograph along a side of one of its small picture.
std::int32_t photo_step(const Camera& camera);
/// Means of blocks of `side` x `side` pixels.
Grey grey_of(const FrameBuffer& frame, std::int32_t side);

/// The strongest corners of a frame of about 320 pixels width or height, spread over it.
PhotoFrame photo_frame(const Camera& camera, const FrameBuffer& frame);

/// Longer side of the small pictures in which corners are found, pixels, about.
inline constexpr std::int32_t kPhotoSide = 320;

struct PhotoTally {
  PoseConvention convention;
  int fits = 0;                           ///< matches that lie within 1.5 pixels of their epipolar half line
  int better_pairs = 0, worse_pairs = 0;  ///< pairs of frames where more or fewer fit than as given
};

/// As PhotoTally, under the convention given with all focal lengths divided by `factor`.
struct FocalTally {
  double factor = 1;
  int fits = 0;
  int better_pairs = 0, worse_pairs = 0;
};

struct PhotoTallies {
  std::vector<Track> tracks;        ///< of two frames each, all matches of such pairs; points are not set
  int matches = 0, pairs = 0;       ///< of pairs with enough matches to show that they overlap
  std::vector<PhotoTally> tallies;  ///< the convention given, the other axes, the inverse, both
  std::vector<FocalTally> focal;
  /// Where the matches that fit the convention given lie, of pairs of training frames: world points, and distances from
  /// the first camera of each pair. Only of matches whose rays meet at an angle that shows how far.
  SurveyPoints corners;
  /// By what factor brightness differs between the frames of a pair: e to the median over pairs of the magnitude of the
  /// pair's median logarithm, 1 or more. Nothing where too few pairs say so.
  std::optional<double> exposure;
};

/// Matches between the frames of each pair, held against each convention. `frames` as `as_opened.frames`.
PhotoTallies vote_by_photos(const SceneInfo& as_opened, const std::vector<PhotoFrame>& frames, const FramePairs& pairs,
                            const PoseConvention& given);

}  // namespace semfield
