// A scene as the rest of the house sees it: posed frames, classes, bounds.
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/error.h"
#include "scene/camera.h"
#include "scene/classes/class_table.h"

namespace semfield {

enum class Split : std::uint8_t { train, test, unused };

/// A further channel that a frame offers, by name (plugin/loss.h): feature maps, normals, ... The channel `alpha`
/// has a column, 0 (nothing of the subject) to 1, on the grid of the image: it is scaled with the colours.
struct FrameChannelInfo {
  std::string name;
  std::int32_t height = 0, width = 0;  ///< of its own grid, which covers the image
  std::int32_t cols = 0;               ///< numbers of a cell
};

struct FrameInfo {
  std::string name;    ///< stem used in messages and output files ("rgb_12", "0017")
  std::string source;  ///< path of the colour image, or what stands for it
  Camera camera;
  Pose world_from_camera;  ///< OpenCV camera axes, metres (or the scene's unit)
  Split split = Split::train;
  bool has_depth = false;
  bool has_labels = false;
  bool has_instances = false;
  std::vector<FrameChannelInfo> channels;  ///< further ones, which are read where something wants them
  /// EXIF: how viewers turn the image (formats/image_io.h). Cameras and pixels are those of the file as stored, and
  /// label files tell of the picture as it is shown.
  int orientation = 1;
};

/// What open() tells: a manifest, no pixels.
struct SceneInfo {
  std::string name;
  std::vector<FrameInfo> frames;
  ClassTable classes;      ///< empty when the scene has no labels
  Box bounds;              ///< world box of the content; empty = derive from cameras and depth
  bool metric = true;      ///< false: the unit is unknown (structure from motion)
  double near_hint_m = 0;  ///< 0 = none
  double far_hint_m = 0;
  bool opengl_files = false;  ///< camera axes in the files were OpenGL's; open() turned them
  bool tracked = false;       ///< poses are those that a phone found while it moved: they drift
};

/// Numbers of a further channel; cell (y h / H, x w / W) is that of pixel (y, x). A row of zeros: none.
struct FrameChannel {
  std::string name;
  std::int32_t height = 0, width = 0, cols = 0;
  std::vector<float> values;  ///< [height * width * cols]
};

/// Pixels of one frame, row-major, top-left first. Vectors are empty where the frame has no such channel.
struct FrameBuffer {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::uint8_t> rgb;       ///< [H * W * 3] as stored in the file (display-referred, 0..255)
  std::vector<float> depth_m;          ///< [H * W] depth (Camera::depth_of), 0 = invalid
  std::vector<std::int16_t> label;     ///< [H * W] internal class index, kVoid = void
  std::vector<std::int32_t> instance;  ///< [H * W] instance id, 0 = none
  std::vector<std::uint8_t> used;      ///< [H * W] 0 = masked (scene/scene.h); empty: every pixel counts
  std::vector<std::string> wanted;     ///< set by the caller: names of further channels that read() fills
  std::vector<FrameChannel> channels;  ///< those of FrameInfo::channels that are wanted
};

// Which frames are held out for tests where nothing but their order tells.

/// The parameter `test_every` of datasets that list frames. A frame's rank is its place in the order of names; frames
/// are ranked before any is left out, so that a missing file moves no other frame to another split.
struct HoldOut {
  std::int32_t every = 8;  ///< 0 = none
  std::int32_t first = 0;  ///< rank of the first frame held out

  /// A single frame trains.
  Split split_of(std::size_t rank, std::size_t frames) const;
};

/// What datasets that list frames ask of their parameters: reports a root that is not given, and test_every: 1.
void check_root_and_test_every(const std::string& root, std::int32_t test_every, Diagnostics& diagnostics);

// What the files of a frame are called: one rule for all that write them.

/// What the names of a frame's files begin with: its name, with '/' as '_'.
std::string output_name(std::string_view frame);

/// Frames added so far, by the names of their files.
class OutputNames {
 public:
  /// Adds the next frame. Nothing where it can have files of its own; else what is wrong with its name: empty, longer
  /// than 200 bytes, no line of text, or an earlier frame's files would be called the same.
  std::optional<std::string> add(const std::string& frame);

 private:
  std::map<std::string, std::string> frames_;  // by output name
};

/// What to do about what OutputNames::add finds.
inline constexpr const char* kFrameNameRemedy =
    "give each frame a printable name of its own; '/' becomes '_' in names of files";

/// Every frame must be able to have files of its own: an error for each that cannot. So no two frames of a scene that
/// was opened share a file.
void check_output_names(const SceneInfo& info, Diagnostics& diagnostics);

// Which pixels of a frame count: the others draw no rays, teach nothing and are in no score.

struct FrameBuffer;

/// A bit a pixel, in words of 64, the first pixel lowest. Empty: every pixel counts, which costs nothing.
class PixelMask {
 public:
  static constexpr std::int64_t kWordPixels = 64;

  PixelMask() = default;
  /// `used` [H * W], 0 = masked; empty where no pixel is masked.
  explicit PixelMask(std::span<const std::uint8_t> used);

  bool empty() const { return words_.empty(); }
  bool uses(std::size_t pixel) const { return words_.empty() || ((words_[pixel / 64] >> (pixel % 64)) & 1) != 0; }
  /// 0 for an empty mask.
  std::int64_t masked_px() const { return masked_px_; }
  std::span<const std::uint64_t> words() const { return words_; }
  /// [H * W] of 1 and 0; empty for an empty mask.
  std::vector<std::uint8_t> expand() const;
  std::size_t bytes() const { return words_.capacity() * sizeof(std::uint64_t); }
  bool operator==(const PixelMask&) const = default;

 private:
  std::vector<std::uint64_t> words_;
  std::size_t pixels_ = 0;
  std::int64_t masked_px_ = 0;
};

/// Takes colour, depth, label and instance from the masked pixels of FrameBuffer::used, so that nothing can read what
/// lies there: black, no depth, void, none.
void hide_masked(FrameBuffer& frame);

// Pixels of one frame as a loaded scene keeps them: the narrowest type that holds every value exactly.

/// Values of pixels, all in the narrow type of `Packing` where it holds each of them exactly, else in the wide one.
template <class Packing>
class PackedMap {
 public:
  using Wide = typename Packing::Wide;
  PackedMap() = default;
  explicit PackedMap(std::vector<Wide> values);

  std::size_t size() const { return narrow_.size() + wide_.size(); }
  bool empty() const { return size() == 0; }
  Wide operator[](std::size_t i) const { return narrow_.empty() ? wide_[i] : Packing::widened(narrow_[i]); }
  /// [H * W], the same bits as read.
  std::vector<Wide> expand() const;
  std::size_t bytes() const { return narrow_.capacity() * sizeof(narrow_[0]) + wide_.capacity() * sizeof(Wide); }
  bool operator==(const PackedMap&) const = default;

 private:
  std::vector<typename Packing::Narrow> narrow_;  // one of the two is empty
  std::vector<Wide> wide_;
};

struct LabelPacking {
  using Wide = std::int16_t;
  using Narrow = std::uint8_t;
  static Narrow narrowed(Wide c) { return static_cast<Narrow>(c == kVoid ? 255 : c); }
  static Wide widened(Narrow c) { return c == 255 ? kVoid : static_cast<Wide>(c); }
};
struct DepthPacking {
  using Wide = float;
  using Narrow = std::uint16_t;  // millimetres
  static Narrow narrowed(Wide depth_m);
  static Wide widened(Narrow mm) { return static_cast<float>(mm * 0.001); }
};
/// Class indices, kVoid = void: a byte a pixel up to index 254, else two.
using LabelMap = PackedMap<LabelPacking>;
/// z-depth in metres, 0 = invalid: two bytes per pixel where every value is a whole number of millimetres, else float.
using DepthMap = PackedMap<DepthPacking>;

/// A frame of a loaded scene; channels as in FrameBuffer, empty where the frame has none.
struct StoredFrame {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::uint8_t> rgb;  ///< [H * W * 3] as stored in the file
  DepthMap depth_m;
  LabelMap label;
  std::vector<std::int32_t> instance;
  PixelMask mask;
  std::vector<std::uint8_t> alpha;     ///< [H * W] of the channel `alpha`, 255: the subject covers the pixel
  std::vector<FrameChannel> channels;  ///< but `alpha`

  /// Whether no pixel of it counts, as of one that could not be read.
  bool is_unusable() const { return mask.masked_px() == std::int64_t{width_px} * height_px || rgb.empty(); }
  /// Null where the frame has none of the name.
  const FrameChannel* channel(std::string_view name) const;
  /// Its numbers at pixel `index`, row by row from the top; zeros where the frame has none.
  void read_channel(std::string_view name, std::int32_t index, std::span<float> out) const;

  StoredFrame() = default;
  explicit StoredFrame(FrameBuffer frame);
  std::size_t bytes() const;
};

// The channel `alpha`: how much of each pixel the subject covers. Bytes in files and in memory, a column of floats on
// the way between them, as every further channel.

inline constexpr std::string_view kAlphaChannel = "alpha";

/// What a frame tells that has one.
FrameChannelInfo alpha_info(const Camera& camera);
/// The channel of bytes [H * W], 255 is 1.
FrameChannel alpha_channel(std::int32_t width_px, std::int32_t height_px, std::span<const std::uint8_t> alpha);
/// [H * W] of a channel with values in [0, 1]; undoes alpha_channel exactly.
std::vector<std::uint8_t> alpha_bytes(const FrameChannel& channel);

// Values of label images that stand for no class: one finding for all frames of a scene.

/// Values as text, numbers in their order.
struct ByLengthThenText {
  bool operator()(const std::string& a, const std::string& b) const {
    return std::pair(a.size(), std::string_view(a)) < std::pair(b.size(), std::string_view(b));
  }
};
/// Value -> the first of its pixels.
using UnknownValues = std::map<std::string, std::size_t, ByLengthThenText>;

/// What reading one label image throws for the values that its classes lack. `noun` is "label id" or "colour".
class UnknownLabelError final : public Error {
 public:
  UnknownLabelError(std::string noun, UnknownValues values, const std::string& path, std::int32_t width_px,
                    std::string remedy);

 private:
  friend void report_unknown_labels(const std::vector<FrameInfo>&, const std::vector<std::optional<UnknownLabelError>>&,
                                    Diagnostics&);
  std::string noun_, first_;
  UnknownValues values_;
};

/// One error for those of `frames` that have one, under the place of the first.
void report_unknown_labels(const std::vector<FrameInfo>& frames,
                           const std::vector<std::optional<UnknownLabelError>>& found, Diagnostics& diagnostics);

// What every dataset asks of its poses and cameras before it believes them.

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
/// left, unless another error says why.
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
