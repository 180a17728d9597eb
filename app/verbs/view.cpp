// view: look at a run in the browser, finished or still training.
#include "app/verb.h"

#ifdef SEMFIELD_WITH_SERVE

#include <algorithm>
#include <array>
#include <atomic>
#include <chrono>
#include <cmath>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <stdexcept>
#include <thread>

#include "app/objects/object_files.h"
#include "app/render/run_surface.h"
#include "app/scene/inspect_report.h"
#include "app/serve/page_pictures.h"
#include "app/serve/page_requests.h"
#include "app/serve/page_server.h"
#include "app/signals.h"
#include "core/error.h"
#include "eval/evaluator.h"
#include "eval/image_output.h"
#include "eval/photo_edges.h"
#include "eval/report/report.h"
#include "surface/mesh/mesh_files.h"
#include "train/opened_run.h"
#include "train/run_folder.h"

#endif

namespace semfield::app {

namespace {

struct ViewVerbOptions : PageVerbOptions {
  using PageVerbOptions::PageVerbOptions;
  const std::string& run = operand("run", "run folder");
  const std::vector<std::string>& set = run_settings();
};

#ifdef SEMFIELD_WITH_SERVE

constexpr std::array<long long, 3> kCells{0, 64, 256};  // of the meshes: none, which is there at once, coarse, fine
constexpr std::array<std::int64_t, 3> kRays{0, 120'000, 3'000'000};
constexpr std::int64_t kBandRays = 16'384;  // between two looks at whether anybody still waits
constexpr int kQuality = 90;
constexpr std::array kMaps{"photo", "class", "object", "entropy", "depth"};

// What a picture shows: one of the page's modes.
struct ViewPicture {
  FreeCamera camera;
  std::int32_t width_px = 0, height_px = 0;
  std::string map;                    // of kMaps
  std::array<double, 2> range{0, 1};  // of the colours: nearest and farthest depth, or least and most entropy
};

// A run that somebody looks at. Every call may come from any thread. The field works for one at a time: pictures and
// points come between the views of a mesh that is being made.
class ViewedRun {
 public:
  // Tables of its objects that lack a saved edit are written anew; where they cannot be, a line of the page says so.
  explicit ViewedRun(OpenedRun run)
      : run_(std::move(run)),
        work_(run_.session.work()),
        objects_((fs::path(run_.run_dir) / "objects").string(), run_.session.scene.info) {
    page_ = scene_page_of(run_.session, run_.run_dir, run_.step);
    try {
      objects_.mend();
    } catch (const Error& e) {
      if (e.kind() == ErrorKind::data) throw;
      page_.about.push_back("The tables of the objects lack edits that are saved: " + e.message() + ".");
    }
    show_objects(objects_.look());
  }

  // Step of the newest checkpoint in the folder.
  std::int64_t newest_step() const {
    const std::vector<CheckpointStore::Entry> all =
        CheckpointStore::read(RunFolder::read(run_.run_dir).checkpoints_path()).list();
    return all.empty() ? run_.step : all.front().step;
  }

  // Of the mesh that is made, a number of kCells, and how much of it is, in thousandths.
  std::pair<int, int> progress() const { return {making_, made_}; }

  // The parts of a scene with a mesh, a number of kCells. A field without a surface gives an empty one, and says so
  // among the lines of the page.
  std::string scene(int mesh) {
    const std::shared_ptr<const RunSurface> made = surface(mesh);
    const std::scoped_lock lock(page_lock_);
    const EditedObjects* const now = objects_.look();  // another program may have changed them
    show_objects(now);
    const std::size_t edits = now == nullptr ? 0 : now->edits.edits.size();
    ScenePage page = page_;
    if (mesh > 0 && made->surface.triangles.empty())
      page.about.push_back(trouble_ + ": the field is seen when the camera rests.");
    const auto [facts, bytes] = scene_parts(made->surface, run_.session.scene.info.classes, page,
                                            {{"mesh", mesh}, {"edits", edits}, {"state", shown_}});
    return joined_parts({facts, bytes});
  }

  // JPEG. Empty once `abandoned`. Throws Error(data) for maps that the run lacks.
  std::vector<std::uint8_t> picture(const ViewPicture& wanted, const std::function<bool()>& abandoned) {
    if ((wanted.map == "class" || wanted.map == "entropy") && !run_.session.pipeline->has_semantics())
      throw Error(ErrorKind::data, "run.semantics.none", run_.run_dir + ": the run has no semantics",
                  "train with labels");
    FrameOptions options;
    options.color = wanted.map != "entropy" && wanted.map != "depth";
    options.probability = wanted.map == "class";
    options.classes = run_.session.classes();
    const RayCamera camera = wanted.camera.rays(wanted.width_px, wanted.height_px);
    RenderedFrame whole;
    whole.width_px = wanted.width_px;
    whole.height_px = wanted.height_px;
    const std::int64_t rows_at_once = std::max<std::int64_t>(1, kBandRays / wanted.width_px);
    for (std::int32_t row = 0; row < wanted.height_px; row += static_cast<std::int32_t>(rows_at_once)) {
      if (abandoned()) return {};
      RayCamera band = camera;
      band.camera.height_px = std::min<std::int32_t>(static_cast<std::int32_t>(rows_at_once), wanted.height_px - row);
      band.camera.cy -= row;
      RenderedFrame frame;
      {
        const Turn turn(*this, true);
        frame = render_frame(*run_.session.pipeline, band, run_.session.limits, run_.session.plan.class_of_logit, {},
                             options);
      }
      const auto add = [](auto& to, const auto& part) { to.insert(to.end(), part.begin(), part.end()); };
      add(whole.rgb, frame.rgb);
      add(whole.depth_m, frame.depth_m);
      add(whole.opacity, frame.opacity);
      add(whole.label, frame.label);
      add(whole.entropy, frame.entropy);
      add(whole.probability, frame.probability);
    }
    return encode_jpeg(wanted.width_px, wanted.height_px, painted(wanted, camera, whole), kQuality);
  }

  // {"classes": [{"name", "probability"}, ...] the most probable first, "object": name or null}.
  Json point(Vec3d place) {
    const Session& s = run_.session;
    FieldPoints at;
    {
      const Turn turn(*this, true);
      at = field_at(*s.pipeline, {&place, 1}, {}, s.limits, s.plan.class_of_logit, s.classes());
    }
    std::vector<std::pair<float, int>> order;
    for (int c = 0; c < std::ssize(at.probability); ++c)
      order.emplace_back(-at.probability[static_cast<std::size_t>(c)], c);
    std::sort(order.begin(), order.end());
    Json classes = Json::array();
    for (const auto& [negative, c] : order)
      if (negative < -0.005F || classes.empty())
        classes.push_back({{"name", s.scene.info.classes.valid(c).name}, {"probability", -negative}});
    Json out{{"classes", classes}, {"object", nullptr}};
    if (!at.entropy.empty()) out["entropy"] = at.entropy[0];
    const std::scoped_lock lock(page_lock_);
    if (!page_.objects) return out;
    const std::int32_t id = page_.objects->at(place);
    if (id > 0)
      out["object"] = object_name(page_.objects->rows[static_cast<std::size_t>(id) - 1], s.scene.info.classes);
    return out;
  }

  // Applies and keeps an edit of the objects that have the state `made_on`; none: takes the last one back. {"objects",
  // "ids", "edits", "state", "said"}, ids as base64 of 16 bits for every vertex. Throws as ObjectFolder::edit;
  // nothing has changed then.
  Json edit(const std::optional<ObjectEdit>& edit, const std::string& made_on, int mesh) {
    const std::shared_ptr<const RunSurface> made = surface(mesh);
    const std::scoped_lock lock(page_lock_);
    const EditedObjects& now = objects_.edit(edit, made_on);
    show_objects(&now);
    const std::vector<std::uint16_t> ids = vertex_objects(made->surface, now.set);
    const std::span<const std::uint8_t> bytes(reinterpret_cast<const std::uint8_t*>(ids.data()), 2 * ids.size());
    return {{"objects", page_objects(now.set, run_.session.scene.info.classes)},
            {"ids", base64(bytes)},
            {"edits", now.edits.edits.size()},
            {"state", shown_},
            {"said", edit ? "Saved." : "The last edit is taken back."}};
  }

 private:
  // The field for one call; calls take turns in the order in which they come. What a person waits for comes before a
  // mesh, which gives the field back between its views.
  class Turn : NonCopyable {
   public:
    Turn(ViewedRun& run, bool hurried) : run_(run), hurried_(hurried), scope_(run.work_) {
      if (hurried_) ++run_.hurried_;
      take();
    }
    ~Turn() {
      if (hurried_) --run_.hurried_;
      give();
    }
    void let_others() {
      while (run_.hurried_ > 0) {
        give();
        take();
      }
    }

   private:
    void take() {
      std::unique_lock lock(run_.field_lock_);
      const std::uint64_t own = run_.last_turn_++;
      run_.field_free_.wait(lock, [&] { return run_.turn_ == own; });
    }
    void give() {
      {
        const std::scoped_lock lock(run_.field_lock_);
        ++run_.turn_;
      }
      run_.field_free_.notify_all();
    }

    ViewedRun& run_;
    bool hurried_;
    WorkScope scope_;
  };

  void show_objects(const EditedObjects* now) {
    if (now == nullptr) page_.objects.reset();
    if (now != nullptr && (!page_.objects || shown_ != objects_.state())) page_.objects = now->set;
    shown_ = objects_.state();
  }

  std::shared_ptr<const RunSurface> surface(int mesh) {
    const auto which = static_cast<std::size_t>(mesh);
    const std::scoped_lock made_once(surface_lock_[which]);
    if (mesh == 0 && !surface_[which]) surface_[which] = std::make_shared<const RunSurface>();
    if (surface_[which]) return surface_[which];
    SurfaceWishes wishes;
    wishes.resolution = kCells[which];
    wishes.depth_rays = kRays[which];
    Turn turn(*this, false);
    SurfaceNews news;
    news.views = [&](double done, double of) {
      if (stop_signal() != 0) throw std::runtime_error("the program ends");
      made_ = static_cast<int>(999 * done / of);
      making_ = mesh;
      turn.let_others();
    };
    RunSurface made;
    const std::optional<ObjectSet> objects = [&] {
      const std::scoped_lock lock(page_lock_);
      return page_.objects;
    }();
    try {
      made = make_run_surface(run_.session, run_.run_dir, wishes, {}, objects ? &*objects : nullptr, news);
    } catch (const Error& e) {
      if (e.kind() != ErrorKind::data) throw;
      const std::scoped_lock lock(page_lock_);
      trouble_ = e.message();
    }
    surface_[which] = std::make_shared<const RunSurface>(std::move(made));
    made_ = 1000;
    return surface_[which];
  }

  // Object of each pixel, with borders along the edges of the picture as those of classes have.
  std::vector<std::int16_t> objects_seen(const RayCamera& camera, const RenderedFrame& frame,
                                         std::span<const std::uint8_t> rgb) const {
    constexpr double kMostShares = 1.6e7;
    const SeenPixels pixels = seen_pixels(camera, frame, kSurfaceOpacity);
    std::vector<std::int32_t> ids(pixels.place.size(), 0);
    {
      const std::scoped_lock lock(page_lock_);
      if (page_.objects) ids = page_.objects->at(pixels.place);
    }
    for (std::size_t i = 0; i < ids.size(); ++i)
      if (pixels.seen[i] == 0) ids[i] = 0;
    std::vector<std::int16_t> known(ids.begin(), ids.end());
    std::sort(known.begin(), known.end());
    known.erase(std::unique(known.begin(), known.end()), known.end());
    const std::size_t columns = known.size();
    const auto stride = static_cast<std::int32_t>(
        std::ceil(std::sqrt(static_cast<double>(ids.size()) * static_cast<double>(columns) / kMostShares)));
    ClassEvidence evidence{stride, strided_px(frame.width_px, stride), strided_px(frame.height_px, stride), {}, known};
    std::vector<float> share(static_cast<std::size_t>(std::int64_t{evidence.width_px} * evidence.height_px) * columns);
    for (std::size_t i = 0; i * columns < share.size(); ++i) {
      const PixelPlace at = strided_place(static_cast<std::int64_t>(i), evidence.width_px, stride);
      const std::int32_t id = ids[static_cast<std::size_t>(std::int64_t{at.row} * frame.width_px + at.column)];
      const auto column = std::lower_bound(known.begin(), known.end(), id) - known.begin();
      share[i * columns + static_cast<std::size_t>(column)] = 1;
    }
    evidence.probability = share;
    return labels_on_photo(evidence, rgb, frame.width_px, frame.height_px).label;
  }

  std::vector<std::uint8_t> painted(const ViewPicture& wanted, const RayCamera& camera,
                                    const RenderedFrame& frame) const {
    if (wanted.map == "photo") return to_bytes(frame.rgb);
    if (wanted.map == "depth") return depth_colors(frame.depth_m, wanted.range[0], wanted.range[1]);
    if (wanted.map == "entropy") return entropy_colors(frame.entropy, wanted.range[1]);
    const std::vector<std::uint8_t> rgb = to_bytes(frame.rgb);
    const bool by_class = wanted.map == "class";
    const std::vector<std::int16_t> shown =
        by_class ? labels_on_photo(frame, run_.session.classes(), rgb, frame.width_px, frame.height_px).label
                 : objects_seen(camera, frame, rgb);
    const std::vector<std::uint8_t> of_class =
        by_class ? label_colors(shown, run_.session.scene.info.classes) : std::vector<std::uint8_t>();
    // Classes and objects keep the light of the picture, so that a form is seen.
    std::vector<std::uint8_t> out(rgb.size());
    for (std::size_t i = 0; i < out.size(); ++i) {
      const float* const pixel = &frame.rgb[i - i % 3];
      const double light = static_cast<double>(0.3F * pixel[0] + 0.6F * pixel[1] + 0.1F * pixel[2]);
      double value = 0.35 * 255 * light + 30;
      if (by_class) value = of_class[i] * (0.55 + 0.45 * light);
      if (!by_class && shown[i / 3] > 0) value = ClassTable::default_color(shown[i / 3])[i % 3] * (0.55 + 0.45 * light);
      out[i] = static_cast<std::uint8_t>(std::lround(std::min(value, 255.0)));
    }
    return out;
  }

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
  std::atomic<int> hurried_{0};           // pictures and points that wait or are made
  std::atomic<int> making_{0}, made_{0};  // progress()
  std::array<std::mutex, kCells.size()> surface_lock_;
  std::array<std::shared_ptr<const RunSurface>, kCells.size()> surface_;
};

HttpResponse picture_of(ViewedRun& run, const HttpRequest& request) {
  const Json root = parse_request(request.body, {"camera", "width", "height", "map", "range"});
  ViewPicture wanted;
  wanted.camera = read_request_camera(kRequest.at(root, "camera"));
  wanted.width_px = request_number(root, "width", 1, kMostPictureSide);
  wanted.height_px = request_number(root, "height", 1, kMostPictureSide);
  const Json& map = kRequest.at(root, "map");
  if (std::find(kMaps.begin(), kMaps.end(), map) == kMaps.end())
    kRequest.refuse_value("map", "photo, class, object, entropy or depth", map);
  wanted.map = map.get<std::string>();
  if (wanted.map == "depth" || wanted.map == "entropy") wanted.range = request_numbers<2>(root, "range", 1e9);
  return jpeg_answer(run.picture(wanted, [&] { return request.abandoned(); }));
}

HttpResponse edit_of(ViewedRun& run, const HttpRequest& request) {
  Json root = parse_request(request.body, {"do", "object", "objects", "name", "at", "plane", "mesh", "made_on"});
  const int mesh = request_number(root, "mesh", 0, std::ssize(kCells) - 1);
  const Json made_on = kRequest.at(root, "made_on");
  if (!made_on.is_string()) kRequest.refuse_value("made_on", "a word", made_on);
  root.erase("mesh");
  root.erase("made_on");
  std::optional<ObjectEdit> edit;
  if (kRequest.at(root, "do") != "undo") edit = parse_object_edit(root.dump(), "request");
  return json_answer(run.edit(edit, made_on.get<std::string>(), mesh));
}

// The newest step, and the mesh that is made, once they are others than the page knows; `after`: the revision of the
// answer before.
HttpResponse state_of(ViewedRun& run, News& news, const HttpRequest& request) {
  constexpr std::chrono::milliseconds kLook(1000);  // into the run's folder
  constexpr std::uint64_t kMostSteps = std::uint64_t{1} << 53;
  const std::uint64_t after = query_number(request.query, "after", 0, kMostSteps);
  std::int64_t newest = 0, revision = 0;
  std::pair<int, int> mesh;
  news.wait(request, after == 0, [&](std::chrono::milliseconds left) {
    std::this_thread::sleep_for(std::min(kLook, left));
    newest = run.newest_step();
    mesh = run.progress();
    revision = 1 + mesh.second + 1024 * (mesh.first + 4 * newest);
    return left.count() == 0 || static_cast<std::uint64_t>(revision) != after;
  });
  return json_answer({{"revision", revision}, {"newest", newest}, {"mesh", mesh.first}, {"made", mesh.second}});
}

HttpResponse point_of(ViewedRun& run, const HttpRequest& request) {
  const auto [x, y, z] = request_numbers<3>(parse_request(request.body, {"at"}), "at", 1e9);
  return json_answer(run.point({x, y, z}));
}

// The places of the page of a run, which must outlive whoever answers by them.
PageHost::Places places_of(ViewedRun& run, News& news) {
  return {{"surface",
           {"GET",
            [&](const HttpRequest& r) {
              return bytes_answer(run.scene(static_cast<int>(query_number(r.query, "mesh", 0, kCells.size() - 1))));
            }}},
          {"state", {"GET", [&](const HttpRequest& r) { return state_of(run, news, r); }}},
          {"picture", {"POST", [&](const HttpRequest& r) { return picture_of(run, r); }}},
          {"point", {"POST", [&](const HttpRequest& r) { return point_of(run, r); }}},
          {"edit", {"POST", [&](const HttpRequest& r) { return edit_of(run, r); }}}};
}

int run(const ViewVerbOptions& options, AppContext& context) {
  HostOptions host = host_at(options.address, options.port, "view", "docs/guide/viewing.md");
  host.token = new_token();
  install_stop_signals(!context.quiet);
  ViewedRun viewed(run_of(options.run, options.set, OpenFor::surface, context));
  News news;
  const PageHost server(std::move(host), places_of(viewed, news));
  // While the browser loads the page. What fails here fails for the page too, which says why.
  const std::jthread mesh([&viewed] {
    try {
      (void)viewed.scene(1);
    } catch (const std::exception&) {
      return;
    }
  });
  print_results(context, {{"run", options.run}, {"url", server.url()}}, "view: open " + server.url() + " in a browser");
  while (stop_signal() == 0) std::this_thread::sleep_for(std::chrono::milliseconds(50));
  news.end();
  print_next(context, next_of_run(options.run, false));
  return 128 + stop_signal();
}

#else

int run(const ViewVerbOptions&, AppContext&) {
  throw Error(ErrorKind::unavailable, "serve.page.missing", "this build has no pages that are served",
              "build with -DSEMFIELD_WITH_SERVE=ON, which needs the package libturbojpeg0-dev, or write one: semfield "
              "mesh RUN --out scene.html");
}

#endif

}  // namespace

Verb verb_view() {
  return make_verb<ViewVerbOptions>("view", 20, "look at a run in the browser, while it trains or afterwards",
                                    {"runs/my_photos", "runs/my_photos --port 8790"}, run);
}

}  // namespace semfield::app
