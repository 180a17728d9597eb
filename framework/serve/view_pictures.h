// Pictures for whoever looks: labels of views from their surfaces, free cameras by rendering, in pieces between steps.
#pragma once

#include <cstdint>
#include <list>
#include <memory>
#include <optional>

#include "serve/label_loop.h"
#include "serve/label_state.h"
#include "serve/surface_sight.h"

namespace semfield {

/// Made by the thread that trains.
class ViewPictures {
 public:
  ViewPictures(Training& training, LabelLoop& loop);

  /// Begins a picture; what was under way is forgotten. Throws Error(usage) for a view or camera that cannot be.
  void begin(const PictureRequest& request);
  /// Works on it for about this long; the picture once it is done.
  std::optional<Picture> work(double budget_s);

  /// Clicks that pictures of other views and of free cameras show.
  void set_marks(std::span<const Annotations::Mark> marks, std::span<const int> view_of_frame) {
    places_.set(marks, view_of_frame);
  }

  /// A view that is looked at gets a surface of its own at (nearly) every pixel, for about this long. True when the
  /// labels of the view looked at last can be drawn more finely than before.
  bool refine(double budget_s);

 private:
  struct Fine {
    int view = 0;
    SurfaceMap map;
    std::int64_t done = 0;  ///< pixels
    bool complete() const { return done == static_cast<std::int64_t>(map.distance_m.size()); }
  };
  Fine* find_fine(int view);
  Picture labels_of_view(const PictureRequest& request);
  Picture spot_of(const PictureRequest& request);
  std::vector<SeenMark> seen_by(const RayCamera& camera, const SurfaceDistance& distance, int own);
  std::vector<SeenMark> seen_in_picture();
  // How far from the surface what lies on it may seem to be.
  double tolerance_m() const { return 1.5 * loop_.pool().cell_m(); }
  RayCamera camera_for(const PictureRequest& request) const;
  void render_rows(double budget_s);

  Training& training_;
  LabelLoop& loop_;
  std::list<Fine> fine_;  // the one looked at last comes first
  double rays_per_s_ = 60'000;
  std::optional<PictureRequest> request_;
  RayCamera camera_;
  Picture picture_;
  std::int32_t rows_done_ = 0;
  MarkPlaces places_;
  std::vector<float> distance_m_;  // [rows done * width] of a free camera's picture
  bool shows_labels_ = false;      // something was learned when it began; all of its rows have labels, or none
  double spent_s_ = 0;
};

}  // namespace semfield
