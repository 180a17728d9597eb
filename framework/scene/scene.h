// A scene as the rest of the house sees it: posed frames, classes, bounds.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "core/error.h"
#include "scene/camera.h"
#include "scene/classes/class_table.h"

namespace semfield {

enum class Split : std::uint8_t { train, test, unused };

/// A further channel that a frame offers, by name (plugin/channels.h): feature maps, normals, ... The channel `alpha`
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
  /// EXIF: how viewers turn the image (formats/orientation.h). Cameras and pixels are those of the file as stored, and
  /// label files tell of the picture as it is shown.
  int orientation = 1;
};

/// What open() tells: a manifest, no pixels.
struct SceneInfo {
  std::string name;
  std::vector<FrameInfo> frames;
  ClassTable classes;      ///< empty when the scene has no labels
  Box bounds;              ///< world box of the content; empty = derive from cameras and depth
  Box limit;               ///< world box that nothing lies outside of, as the scene's file tells; empty = not told
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
  std::vector<std::uint8_t> used;      ///< [H * W] 0 = masked (scene/pixel_mask.h); empty: every pixel counts
  std::vector<std::string> wanted;     ///< set by the caller: names of further channels that read() fills
  std::vector<FrameChannel> channels;  ///< those of FrameInfo::channels that are wanted
};

}  // namespace semfield
