// Region noise: whole instances get a wrong class in a share of the frames that see them.
#include <algorithm>
#include <map>
#include <numeric>

#include "compute/parallel.h"
#include "core/rng.h"
#include "labels/training_labels.h"
#include "plugin/module.h"
#include "scene/scene.h"

namespace semfield {

namespace {

constexpr std::string_view kRegionNoise = "region_noise";

enum class RegionMode { sort, even };

}  // namespace

SEMFIELD_CHOICES(RegionMode, "sort", "even");

namespace {

// One instance in one frame.
struct View {
  std::int32_t instance = 0;
  std::size_t frame = 0;
  std::int64_t pixels = 0;     // labelled ones
  std::int16_t label = kVoid;  // of most of them, the first of equals
  std::int64_t label_pixels = 0;
};

struct Flip {
  std::int32_t instance = 0;
  std::int16_t label = kVoid;
};

// Instances of a frame by ascending id; pixels without instance (0) or label count in none.
std::vector<View> views_of(std::size_t frame, const std::vector<std::int32_t>& instance,
                           const std::vector<std::int16_t>& label) {
  std::map<std::int32_t, std::map<std::int16_t, std::int64_t>> histogram;
  for (std::size_t p = 0; p < label.size();) {  // by runs of a row: neighbours are mostly alike
    std::size_t end = p + 1;
    while (end < label.size() && instance[end] == instance[p] && label[end] == label[p]) ++end;
    if (instance[p] != 0 && label[p] != kVoid) histogram[instance[p]][label[p]] += static_cast<std::int64_t>(end - p);
    p = end;
  }
  std::vector<View> out;
  for (const auto& [id, counts] : histogram) {
    View view{id, frame, 0, kVoid, 0};
    for (const auto& [c, pixels] : counts) {
      view.pixels += pixels;
      if (pixels > view.label_pixels) {
        view.label = c;
        view.label_pixels = pixels;
      }
    }
    out.push_back(view);
  }
  return out;
}

// Class of most pixels over all frames.
std::int16_t class_of(const std::vector<View>& views) {
  std::map<std::int16_t, std::int64_t> pixels;
  for (const View& view : views) pixels[view.label] += view.label_pixels;
  std::int16_t best = kVoid;
  for (const auto& [c, n] : pixels) {
    if (best == kVoid || n > pixels[best]) best = c;
  }
  return best;
}

std::string ids_text(const std::vector<std::int32_t>& ids) {
  std::vector<std::string> words;
  for (const std::int32_t id : ids) words.push_back(std::to_string(id));
  return join(words);
}

using ViewsOfInstance = std::map<std::int32_t, std::vector<View>>;

class RegionNoise final : public Degradation {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, ratio,
                   "share of the frames that see a chosen instance in which its class is wrong, to the nearest whole "
                   "number",
                   {0, 1});
    SEMFIELD_PARAM(visit, *this, mode,
                   "which of these frames, ordered by the share that the instance covers: the smallest, or evenly "
                   "spaced ranks");
    SEMFIELD_PARAM(visit, *this, instances, "ids of the chosen instances; empty = all that the next two keys allow",
                   {1, 2147483647});
    SEMFIELD_PARAM(visit, *this, classes, "names of the classes whose instances are chosen; empty = every class");
    SEMFIELD_PARAM(visit, *this, min_frames, "instances seen in fewer labelled frames are not chosen", {1, 1e6});
  }

  void validate(Diagnostics& diagnostics) const override {
    if (!instances.empty() && !classes.empty())
      diagnostics.error("config.value.conflict", "region_noise.classes", "instances and classes exclude each other",
                        "keep one of them");
  }

  bool needs_instances() const override { return true; }

  StepFacts apply(const LoadedScene& scene, std::uint64_t seed, LabelSet& labels) const override {
    const std::vector<std::int16_t> others = scene_classes(scene, kRegionNoise);
    if (others.size() < 2) {
      throw Error(ErrorKind::data, "labels.classes.too_few",
                  std::string(kRegionNoise) + ": the scene has one class, so no label can be a wrong one",
                  "remove this degradation");
    }
    const ViewsOfInstance views = chosen(scene, all_views(scene, labels));
    std::vector<std::vector<Flip>> flips(labels.size());  // by ascending instance
    std::size_t seen = 0, flipped = 0;
    std::vector<std::int32_t> ids;
    for (const auto& [id, of_instance] : views) {
      ids.push_back(id);
      seen += of_instance.size();
      for (const View& view : picked(scene, of_instance)) {
        flips[view.frame].push_back({id, other_class(others, view, seed)});
        ++flipped;
      }
    }
    std::vector<std::int64_t> pixels(labels.size());
    StepFacts facts =
        change_hard_labels(scene, kRegionNoise, labels, [&](std::size_t f, std::vector<std::int16_t>& hard) {
          for (std::size_t p = 0; p < hard.size(); ++p) {
            const std::int32_t id = scene.frames[f].instance[p];
            const auto at =
                std::lower_bound(flips[f].begin(), flips[f].end(), id,
                                 [](const Flip& flip, std::int32_t wanted) { return flip.instance < wanted; });
            if (at == flips[f].end() || at->instance != id || hard[p] == kVoid) continue;
            hard[p] = at->label;
            ++pixels[f];
          }
        });
    facts.emplace_back("pixels of flipped regions",
                       std::to_string(std::accumulate(pixels.begin(), pixels.end(), std::int64_t{0})));
    facts.emplace_back("instances chosen", ids_text(ids));
    facts.emplace_back("views of them (an instance in a frame)", std::to_string(seen));
    facts.emplace_back("views flipped", std::to_string(flipped));
    return facts;
  }

  double ratio = 0.3;
  RegionMode mode = RegionMode::sort;
  std::vector<std::int64_t> instances;
  std::vector<std::string> classes;
  int min_frames = 2;

 private:
  ViewsOfInstance all_views(const LoadedScene& scene, const LabelSet& labels) const {
    const std::vector<std::size_t> frames = hard_frames(scene, labels, kRegionNoise);
    for (const std::size_t f : frames) {
      if (scene.frames[f].instance.empty()) {
        throw Error(ErrorKind::data, "scene.instances.none",
                    std::string(kRegionNoise) + ": " + frame_place(scene.info.frames[f]) + " has no instance image",
                    "use a scene whose dataset reads instances (docs/reference/plugins.md says which do), or another "
                    "degradation");
      }
    }
    std::vector<std::vector<View>> of_frame(frames.size());
    parallel_for(static_cast<std::int64_t>(frames.size()), [&](std::int64_t i) {
      const std::size_t f = frames[static_cast<std::size_t>(i)];
      of_frame[static_cast<std::size_t>(i)] = views_of(f, scene.frames[f].instance, labels[f].hard);
    });
    ViewsOfInstance views;
    for (const std::vector<View>& in_frame : of_frame) {
      for (const View& view : in_frame) views[view.instance].push_back(view);
    }
    return views;
  }

  ViewsOfInstance chosen(const LoadedScene& scene, ViewsOfInstance views) const {
    check_names(scene, views);
    std::erase_if(views, [&](const auto& entry) {
      const auto& [id, of_instance] = entry;
      if (!instances.empty()) return std::find(instances.begin(), instances.end(), id) == instances.end();
      if (of_instance.size() < static_cast<std::size_t>(min_frames)) return true;
      const std::string& name = scene.info.classes.valid(class_of(of_instance)).name;
      return !classes.empty() && std::find(classes.begin(), classes.end(), name) == classes.end();
    });
    if (views.empty()) {
      throw Error(ErrorKind::data, "labels.instances.none",
                  std::string(kRegionNoise) + ": no instance of the classes asked for is seen in " +
                      std::to_string(min_frames) + " labelled training frames",
                  "lower its min_frames, name other classes, or label more frames");
    }
    return views;
  }

  void check_names(const LoadedScene& scene, const ViewsOfInstance& views) const {
    for (const std::int64_t id : instances) {
      if (views.count(static_cast<std::int32_t>(id)) > 0) continue;
      std::vector<std::int32_t> known;
      for (const auto& entry : views) known.push_back(entry.first);
      throw Error(
          ErrorKind::data, "labels.instances.none",
          std::string(kRegionNoise) + ".instances: no labelled training frame sees instance " + std::to_string(id),
          known.empty() ? "label frames that show instances" : "there are " + ids_text(known));
    }
    std::vector<std::string> known;
    for (int c = 0; c < scene.info.classes.valid_count(); ++c) known.push_back(scene.info.classes.valid(c).name);
    for (const std::string& name : classes) {
      if (std::find(known.begin(), known.end(), name) != known.end()) continue;
      throw Error(ErrorKind::data, "labels.class.unknown",
                  std::string(kRegionNoise) + ".classes: the class table has no class '" + name + "'",
                  near_name_remedy(name, known, "see `semfield inspect` for the names"));
    }
  }

  // The frames in which an instance is flipped, in the order of the share that it covers.
  std::vector<View> picked(const LoadedScene& scene, std::vector<View> views) const {
    const auto frame_pixels = [&](const View& v) {
      return std::int64_t{scene.frames[v.frame].width_px} * scene.frames[v.frame].height_px;
    };
    std::stable_sort(views.begin(), views.end(), [&](const View& a, const View& b) {  // equal shares: by frame
      return a.pixels * frame_pixels(b) < b.pixels * frame_pixels(a);
    });
    const auto all = static_cast<std::int64_t>(views.size());
    const std::int64_t count = rounded_share(ratio, all);
    std::vector<View> out;
    for (std::int64_t k = 0; k < count; ++k) {
      // Middle of the k-th of `count` equal parts of the ranks: neither end is favoured.
      const std::int64_t rank = mode == RegionMode::sort ? k : (2 * k + 1) * all / (2 * count);
      out.push_back(views[static_cast<std::size_t>(rank)]);
    }
    return out;
  }

  static std::int16_t other_class(const std::vector<std::int16_t>& all, const View& view, std::uint64_t seed) {
    const RandomAddress address{seed, view.frame, stream_id("labels/region_noise")};
    const auto own = static_cast<std::size_t>(std::find(all.begin(), all.end(), view.label) - all.begin());
    const bool known = own < all.size();  // a label read from files may be of a class that the truth lacks
    const std::size_t draw =
        uniform_below(address, static_cast<std::uint64_t>(view.instance), all.size() - (known ? 1 : 0));
    return all[known && draw >= own ? draw + 1 : draw];
  }
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(region_noise, "1.0", [](Registry& registry) {
  registry.add_degradation<RegionNoise>("region_noise",
                                        "a wrong class on whole instances in a share of the frames that see them");
})

}  // namespace semfield
