// Pictures for whoever looks: labels of views from their surfaces, or rendered, between steps.
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

#include "eval/evaluator.h"
#include "labels/clicks.h"
#include "labels/serve/label_loop.h"
#include "scene/scene.h"
#include "surface/surface_graph.h"
#include "surface/things.h"

namespace semfield {

/// A click of another view that a picture shows: the places of it that are seen.
struct SeenMark {
  std::string id;
  std::vector<PixelPoint> points;  ///< pixels of the picture
};

/// What a click means: places of the view on the thing and beside it (ThingTree::choose).
struct ThingRequest {
  std::vector<PixelPoint> also, without;  ///< pixels of the view; what lies outside counts for the edge
  int level = 0;
};

struct PictureRequest {
  std::string client;  ///< a later request of the same client takes the place of one that waits
  int view = 0;        ///< number in LabelState::views
  bool color = false;  ///< rendered colour
  bool labels = true;
  bool entropy = false;
  bool full = false;                                 ///< every pixel rendered: the view's final labels
  std::optional<ThingRequest> thing = std::nullopt;  ///< its mask alone is wanted, not what is named above
};

struct ThingFacts {
  int level = 0, least = 0, most = 0;  ///< as in Thing
  double share = 0;                    ///< of the picture
  int class_guess = -1;                ///< index; -1: none
};

/// Maps row by row; those that were not requested are empty.
struct Picture {
  std::int32_t width_px = 0, height_px = 0;
  std::vector<std::uint8_t> rgb;
  std::vector<std::int16_t> label;    ///< class indices, kVoid for none
  std::vector<std::uint8_t> entropy;  ///< 0 to 255: a fraction of the largest there can be
  std::vector<SeenMark> seen;         ///< clicks of other views; with labels alone
  std::uint64_t overlay_revision = 0;
  double render_ms = 0;
  std::optional<ThingFacts> thing = std::nullopt;  ///< then `label` is 0 on the thing and kVoid elsewhere
  bool stale = false;  ///< nothing was made: a later request took the place, or the session ends
};

/// Image point where a camera sees a world position; nothing behind the camera or outside of its image.
std::optional<PixelPoint> pixel_of(const RayCamera& camera, Vec3d place);

/// pixel_of() where the place lies on the surface that the camera sees there by its map, up to `tolerance_m` or 3 % of
/// the distance; nothing where something hides it, or where the map is not made yet.
std::optional<PixelPoint> seen_at(const RayCamera& camera, const SurfaceMap& map, Vec3d place, double tolerance_m);

/// The latest of the clicks, at most 1,000, that view `own` sees by `map`; its own are left out. They lie on the
/// surface of the maps of their views; a stroke has up to eight places there.
std::vector<SeenMark> marks_seen(std::span<const Annotations::Mark> marks, const SurfaceMap& map, int own,
                                 std::span<const PoolView> views, const RayLimits& limits, double tolerance_m);

inline constexpr double kThingPixels = 260'000;

/// Made by the thread that trains.
class ViewPictures {
 public:
  /// A photograph of a view, as large as there is one up to so many pixels of its longer side.
  using PhotoReader = std::function<Image<std::uint8_t>(int view, std::int32_t most_px)>;
  ViewPictures(Trainer& training, LabelLoop& loop, PhotoReader read_photo);

  /// Labels of the view's surface at its photograph's size, at first at that of training; with colour it is rendered,
  /// as large as it can be soon, and `full` whole, however long that takes. A thing is a mask of at most kThingPixels.
  /// Throws Error(usage) for a view that is not there.
  Picture make(const PictureRequest& request);

  /// Clicks that pictures of other views show.
  void set_marks(std::vector<Annotations::Mark> marks) { marks_ = std::move(marks); }

  /// A view that is looked at gets a surface of its own at (nearly) every pixel, for about this long. True when the
  /// labels of the view looked at last can be drawn more finely than before.
  bool refine(double budget_s);

 private:
  struct Fine {
    int view = 0;
    SurfaceMap map;
    std::int64_t done = 0;                     ///< pixels
    std::optional<Image<std::uint8_t>> photo;  ///< larger than the one that trains; without pixels where there is none
    bool complete() const { return done == static_cast<std::int64_t>(map.distance_m.size()); }
  };
  Picture labels_of_view(const PictureRequest& request);
  std::vector<SeenMark> seen_by(int view, const SurfaceMap& map) const;
  // How far from the surface what lies on it may seem to be.
  double tolerance_m() const { return 1.5 * loop_.pool().cell_m(); }
  Picture rendered(const PictureRequest& request);
  Image<std::uint8_t> larger_photo(int view) const;
  // The tree of a view by its map as it is now.
  struct KnownThings {
    int view = 0;
    std::int64_t step = 0;  // of the map
    ThingTree tree;
  };
  const ThingTree& things_of(int view);
  int guessed_class(int view, const Thing& thing, const ThingTree& tree) const;
  Picture thing(int view, const ThingRequest& request);

  Trainer& training_;
  LabelLoop& loop_;
  PhotoReader read_photo_;
  std::vector<Fine> fine_;           // the one looked at last comes first
  std::vector<KnownThings> things_;  // likewise
  double rays_per_s_ = 60'000;
  std::vector<Annotations::Mark> marks_;
};

// Labels at the size of a view's stored image, which training may have made smaller.

/// Labels are rendered at every `stride`-th pixel of the stored image, about as many as training saw, and brought to
/// the others along its edges (eval/photo_edges.h).
struct StoredSize {
  Camera camera;            ///< of the stored image
  std::int32_t stride = 1;  ///< FrameOptions::stride
};

/// None for a frame of that size already, one without an image file, and one whose file has another shape, such as one
/// that is turned by its EXIF data.
std::optional<StoredSize> stored_size_of(const FrameInfo& frame);

}  // namespace semfield
