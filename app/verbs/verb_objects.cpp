// objects: things of a run's scene told apart by segments of its images, as images, a table, points and figures.
#include <fmt/format.h>

#include <algorithm>
#include <cstdio>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>
#include <optional>

#include "app/json_output.h"
#include "app/objects/object_files.h"
#include "app/scene/inspect_report.h"
#include "app/terminal.h"
#include "app/verb.h"
#include "core/error.h"
#include "objects/find_objects.h"
#include "objects/object_score.h"
#include "objects/segments.h"
#include "run/run_scores.h"
#include "system/files.h"

namespace semfield::app {

namespace {

struct ObjectsOptions : Options {
  explicit ObjectsOptions(const Declaration& at) : Options(at) {
    needs("--pattern", "--segments");
    needs("--pictures", "--score");
  }
  const std::string& run = operand("run", "run folder");
  const std::string& segments =
      value("--segments PATH",
            "segments of the training images: a folder of PNGs, JSON or NumPy masks, a COCO file, or clicks.jsonl "
            "(default: the "
            "scene's own "
            "instances)");
  const std::string& pattern =
      value("--pattern NAME", "how files of that folder are named, with {name}, {stem} or {number} of the frame");
  const std::string& split =
      choice("--split SPLIT", "test", {"test", "train"}, "frames whose objects are written as images");
  const bool& score = flag("--score", "also figures of those frames against the scene's own labels and instances");
  const bool& pictures =
      flag("--pictures", "also those frames as strips for the eye: photograph, segments, objects found, true objects");
  const std::string& out = value("--out FOLDER", "folder to write (default: objects/ in the run folder)");
  const std::vector<std::string>& set = run_settings();
};

PluginSlot usual_method(const Registry& registry) {
  PluginSlot slot;
  slot.entry = &registry.usual_grouping();
  slot.params = slot.entry->new_params();
  return slot;
}

Json figures_json(const ObjectFigures& f) {
  return {{"pq", f.pq},
          {"sq", f.sq},
          {"rq", f.rq},
          {"pq_things", f.pq_things},
          {"pq_stuff", f.pq_stuff},
          {"mcov", f.mcov},
          {"count_error", f.count_error},
          {"true_objects", f.objects},
          {"found_objects", f.found},
          {"matched_objects", f.matched}};
}

Json about(const ObjectsOptions& options, const OpenedRun& run, const SegmentSet& segments, const FoundObjects& found) {
  const Session& s = run.session;
  Json seconds;
  double all = 0;
  for (const auto& [part, took] : found.seconds) {
    seconds[part] = took;
    all += took;
  }
  seconds["all"] = all;
  RunConfig& editable = const_cast<RunConfig&>(s.config);  // describe() takes a mutable struct; the writer only looks
  return {
      {"run", options.run},
      {"step", run.step},
      {"segments_from", segments.from},
      {"segments", segments.count()},
      {"method", s.config.grouping.entry->name},
      {"parameters", write_config(params_to_config([&](ParamVisitor& visit) { describe(visit, editable.objects); }))},
      {"damage",
       write_config(params_to_config([&](ParamVisitor& visit) { describe(visit, editable.segment_damage); }))},
      {"cell", found.surface.pool.cell_m()},
      {"seconds", seconds}};
}

Split split_of(const ObjectsOptions& options) { return options.split == "test" ? Split::test : Split::train; }

std::vector<int> frames_of(const ObjectsOptions& options, const Session& s) {
  return s.scene.frames_of(split_of(options));
}

// What the segments of the frames shown would be, were they given like those of the training frames; empty where these
// come from files.
SegmentSet shown_segments(const ObjectsOptions& options, const Session& s) {
  SegmentSet shown;
  shown.frames.resize(s.scene.frames.size());
  if (!options.segments.empty()) return shown;
  shown = segments_of_scene(s.scene, split_of(options));
  damage_segments(shown, s.config.segment_damage, s.config.objects.seed);
  return shown;
}

bool has_truth(const Session& s, int frame) {
  const StoredFrame& stored = s.scene.frames[static_cast<std::size_t>(frame)];
  return !stored.instance.empty() && !stored.label.empty();
}

// Before any work, and before any file.
void check_truth(const ObjectsOptions& options, const Session& s) {
  const std::vector<int> frames = frames_of(options, s);
  if (!options.score || std::any_of(frames.begin(), frames.end(), [&](int f) { return has_truth(s, f); })) return;
  throw Error(ErrorKind::data, "objects.truth.none",
              options.run + ": no frame of split '" + options.split + "' has true labels and instances",
              "leave --score out");
}

// Renders the views, writes them, and scores those of which the scene knows objects.
std::optional<ObjectFigures> write_views(const ObjectsOptions& options, Session& s, FoundObjects& found,
                                         ObjectFiles& files, const AppContext& context) {
  const std::vector<int> frames = frames_of(options, s);
  ObjectScore score(found.rows, found.stuff, ObjectScore::kLeastPx);
  const SegmentSet shown = options.pictures ? shown_segments(options, s) : SegmentSet();
  ProgressLine progress(context, "rendered");
  for (std::size_t k = 0; k < frames.size(); ++k) {
    const auto n = static_cast<std::size_t>(frames[k]);
    const FrameInfo& info = s.scene.info.frames[n];
    const RayCamera camera{info.camera, info.world_from_camera, s.plan.undistortion};
    std::vector<std::int16_t> label;
    if (s.pipeline->has_semantics()) {
      FrameOptions wanted;
      wanted.color = false;
      label = render_named_frame(*s.pipeline, info.name, camera, s.limits, s.plan.class_of_logit, {}, wanted).label;
    }
    const std::vector<std::int32_t> ids = object_ids(s, found, camera, label);
    files.add({info, ids, label});
    progress.show(static_cast<double>(k + 1), static_cast<double>(frames.size()));
    if (!options.score || !has_truth(s, frames[k])) continue;
    const std::vector<std::int16_t> true_label = s.scene.frames[n].label.expand();
    score.add({true_label, s.scene.frames[n].instance, label, ids});
    if (options.pictures)
      write_object_strip(files.picture_path(info), s.scene.frames[n], shown.frames[n], ids, found.stuff);
  }
  if (!options.score) return std::nullopt;
  return score.figures();
}

SegmentSet segments_of(const ObjectsOptions& options, const LoadedScene& scene, const AppContext& context) {
  if (options.segments.empty()) return segments_of_scene(scene);
  if (!options.segments.ends_with(".jsonl")) return read_segments(options.segments, options.pattern, scene.info);
  Diagnostics diagnostics;
  SegmentSet clicks = segments_of_clicks(options.segments, scene.info, diagnostics);
  for (const Diagnostic& finding : diagnostics.all()) print_note(context, finding.shown());
  return clicks;
}

void tell_unclaimed(const FoundObjects& found, const SegmentSet& segments, const Session& s,
                    const AppContext& context) {
  if (found.unclaimed.empty()) return;
  const Annotations::Mark& first = segments.clicks[found.unclaimed.front()];
  const SceneInfo& info = s.scene.info;
  print_note(context,
             fmt::format("{} of {} clicks are of no object, the first one on '{}' in frame '{}': there is too "
                         "little surface around them; raise objects.points and objects.rays",
                         found.unclaimed.size(), segments.clicks.size(), info.classes.valid(first.class_index).name,
                         info.frames[static_cast<std::size_t>(first.frame)].name));
}

int run(const ObjectsOptions& options, AppContext& context) {
  OpenedRun opened = run_of(options.run, options.set, OpenFor::objects, context);
  Session& s = opened.session;
  check_truth(options, s);
  if (s.config.grouping.entry == nullptr) s.config.grouping = usual_method(context.registry);
  SegmentSet segments = segments_of(options, s.scene, context);
  damage_segments(segments, s.config.segment_damage, s.config.objects.seed);
  const std::string folder =
      options.out.empty() ? (std::filesystem::path(options.run) / "objects").string() : options.out;
  // From here on, so that nobody edits objects that are about to be others.
  FolderLock alone;
  if (std::filesystem::is_directory(folder)) alone = hold_objects(folder, 0);
  ProgressLine progress(context, "objects");
  std::string stage;
  const auto show = [&](const char* part, double done, double of) {
    if (stage != part) {
      stage = part;
      progress.restart(stage, stage == "learned" ? "steps" : "frames");
    }
    progress.show(done, of);
  };
  FoundObjects found = find_objects(s, segments, s.config.grouping.entry->grouping(*s.config.grouping.params),
                                    context.registry.kernels(), show);
  tell_unclaimed(found, segments, s, context);
  check_object_count(found.rows);
  if (!alone.held()) {
    create_folders(folder);
    alone = hold_objects(folder, 0);
  }
  EditedObjects objects;
  objects.set = object_set(found, about(options, opened, segments, found).dump());
  const ObjectSet as_found = objects.set;
  const std::string edits_file = (std::filesystem::path(folder) / "edits.json").string();
  objects.edits = read_object_edits(edits_file);
  apply_edits(objects.set, objects.edits, edits_file);
  objects.edits.digest = as_found.digest();
  found.id = objects.set.id;
  found.rows = objects.set.rows;
  ObjectFiles files(folder, found, s.scene.info);
  const std::optional<ObjectFigures> figures = write_views(options, s, found, files, context);
  Json facts = Json::parse(objects.set.about);
  facts["edits"] = objects.edits.edits.size();
  if (figures) facts["score"] = figures_json(*figures);
  files.finish();
  objects.set.about = facts.dump();
  write_object_set((std::filesystem::path(folder) / "found.safetensors").string(), as_found);
  write_object_tables(folder, objects, s.scene.info);
  const auto count =
      std::count_if(found.rows.begin(), found.rows.end(), [](const ObjectRow& row) { return row.points > 0; });
  if (context.json) {
    Json out = facts;
    out["objects"] = count;
    out["folder"] = folder;
    print_json(context, out);
    return 0;
  }
  std::map<std::string, int> counts;
  for (const ObjectRow& row : found.rows)
    if (row.points > 0) ++counts[object_class_name(row, s.scene.info.classes)];
  for (const auto& [name, of_class] : counts) std::printf("  %-20s %d\n", name.c_str(), of_class);
  if (figures)
    std::printf("score: pq=%.4f sq=%.4f rq=%.4f mcov=%.4f count_error=%.4f true=%lld found=%lld\n", figures->pq,
                figures->sq, figures->rq, figures->mcov, figures->count_error, static_cast<long long>(figures->objects),
                static_cast<long long>(figures->found));
  std::printf("objects: objects=%lld segments=%lld seconds=%.1f folder=%s\n", static_cast<long long>(count),
              static_cast<long long>(segments.count()), facts["seconds"]["all"].get<double>(), folder.c_str());
  print_next(context, next_of_look(options.run));
  return 0;
}

}  // namespace

Verb verb_objects() {
  return make_verb<ObjectsOptions>("objects", 65, "separate and count the things of a scene, by segments of its images",
                                   run);
}

}  // namespace semfield::app
