// The page of `semfield view`: a run that somebody looks at, and its places over HTTP.
#pragma once

#include <array>
#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <functional>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "app/objects/object_files.h"
#include "app/render/run_surface.h"
#include "app/render/scene_page.h"
#include "app/serve/page_server.h"
#include "run/run_scores.h"
#include "serve/label_loop.h"

namespace semfield::app {

/// What a picture shows: one of the page's modes.
struct ViewPicture {
  FreeCamera camera;
  std::int32_t width_px = 0, height_px = 0;
  std::string map;               ///< photo, class, object, entropy, depth or probability
  int class_index = 0;           ///< of probability
  double near_m = 0, far_m = 1;  ///< of depth's colours
};

/// Every call may come from any thread. The field works for one at a time: pictures and points come between the views
/// of a mesh that is being made.
class ViewedRun {
 public:
  /// Takes over the run. Tables of its objects that lack a saved edit are written anew; where they cannot be, a line of
  /// the page says so.
  explicit ViewedRun(OpenedRun run);

  const std::string& folder() const { return run_.run_dir; }
  std::string name() const { return page_.run; }
  std::int64_t step() const { return run_.step; }
  /// Step of the newest checkpoint in the folder.
  std::int64_t newest_step() const;

  /// scene_bytes of a coarse mesh, which is there soon, or of one as `semfield mesh` makes it. A field without a
  /// surface gives an empty mesh, and says so among the lines of the page.
  std::string scene(bool fine);
  /// JPEG. Empty once `abandoned`. Throws Error(data) for a class that is not there, and for maps that the run lacks.
  std::vector<std::uint8_t> picture(const ViewPicture& wanted, const std::function<bool()>& abandoned);
  /// {"classes": [{"name", "probability"}, ...] the most probable first, "object": name or null} as JSON.
  std::string point(Vec3d place);
  /// The probability of a class at every vertex of a mesh, 0 to 255. Throws Error(data) for a class that is not there.
  std::string probability(int class_index, bool fine);
  /// Applies and keeps an edit of the objects that have the state `made_on`; none: takes the last one back. {"objects",
  /// "ids", "edits", "state", "said"} as JSON, ids as base64 of 16 bits for every vertex. Throws as ObjectFolder::edit;
  /// nothing has changed then.
  std::string edit(const std::optional<ObjectEdit>& edit, const std::string& made_on, bool fine);

 private:
  class Turn;
  std::shared_ptr<const RunSurface> surface(bool fine);
  void check_class(int class_index) const;
  void paint(const ViewPicture& wanted, const RayCamera& band, const RenderedFrame& frame,
             std::vector<std::uint8_t>& rgb) const;
  void show_objects(const EditedObjects* now);

  OpenedRun run_;
  WorkSettings work_;
  ScenePage page_;
  ObjectFolder objects_;
  std::string shown_;             // the state of page_.objects
  std::string trouble_;           // of the surface
  mutable std::mutex page_lock_;  // of page_, objects_ and shown_
  std::mutex field_lock_;         // of these two; the field belongs to the call whose turn it is
  std::uint64_t turn_ = 0, last_turn_ = 0;
  std::condition_variable field_free_;
  std::atomic<int> hurried_{0};  // pictures and points that wait or are made
  std::array<std::mutex, 2> surface_lock_;
  std::array<std::shared_ptr<const RunSurface>, 2> surface_;  // coarse, fine
};

struct ViewOptions {
  HttpOptions http;
  bool next_port = false;  ///< when http.port is taken, one of the 99 behind it
  ExportOptions films;     ///< of the first run
  std::string page;        ///< live_page_text()
};

class ViewServer final : public PageHost {
 public:
  /// Serves when it returns; `runs`, one or two, must outlive it. Throws as free_port does.
  ViewServer(std::vector<ViewedRun*> runs, ViewOptions options);
  ~ViewServer() override { close(); }

 private:
  HttpResponse get_surface(const HttpRequest& request) const;
  HttpResponse get_probability(const HttpRequest& request) const;
  HttpResponse get_state() const;
  HttpResponse post_picture(const HttpRequest& request) const;
  HttpResponse post_point(const HttpRequest& request) const;
  HttpResponse post_edit(const HttpRequest& request) const;
  HttpResponse post_film(const HttpRequest& request);
  ViewedRun& run(std::uint64_t number) const;

  std::vector<ViewedRun*> runs_;
};

}  // namespace semfield::app
