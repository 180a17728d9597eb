// report.html: one self-contained page about one or several runs; the same input gives the same bytes.
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "eval/final_eval.h"
#include "labels/clicks/annotations.h"
#include "run/metrics_log.h"
#include "run/run_folder.h"
#include "run/run_scores.h"
#include "session/session.h"

namespace semfield {

/// One PNG of a strip.
struct ReportImage {
  std::string caption;            ///< "truth", "colour", "label truth", "label", "entropy", "depth"
  std::vector<std::uint8_t> png;  ///< the file's bytes
};

/// A frame as a row of images.
struct ReportStrip {
  std::string name;  ///< frame name
  std::string note;  ///< e.g. "mIoU 0.31, PSNR 18.2 dB"; may be empty
  std::vector<ReportImage> images;
};

struct ReportClass {
  std::string name;
  std::array<std::uint8_t, 3> color{};
};

using ReportFacts = std::vector<std::pair<std::string, std::string>>;

/// One curve in every plot and one column in every table.
struct ReportRun {
  std::string name;              ///< shown in legends; unique
  std::vector<MetricsRow> rows;  ///< of metrics.jsonl
  std::string config;            ///< resolved YAML; may be empty
  std::string scene;             ///< its type and place, of the configuration; may be empty
  ReportFacts environment;
  std::vector<LeftOutRow> left_out;
  std::optional<LabelCounts> labels;       ///< of labels.json
  std::optional<FinalEval> eval;           ///< of final_eval.json
  std::optional<LabellingRecord> clicked;  ///< of labelling.json
};

struct ReportInput {
  std::string title;                 ///< e.g. the scene's name
  std::string subtitle;              ///< one sentence: configuration, split
  std::string split;                 ///< whose evaluations count; empty: report_split of the first run
  std::vector<ReportRun> runs;       ///< at least one
  std::vector<ReportClass> classes;  ///< order and colours of the per-class list; empty: order of the rows, no colours
  std::vector<ReportStrip> strips;
  std::vector<ReportStrip> worst;    ///< worst frames, worst first
  std::vector<ReportStrip> clicked;  ///< frames with the most clicks, the most first
  std::string scene;                 ///< a page that stands alone and shows the first run in 3D; may be empty
};

/// Split of the last evaluation, of a sample of it too; one of training frames only where there is no other.
std::string report_split(const std::vector<MetricsRow>& rows);

/// The page: no network, images inside, and no script but that of `input.scene`, named by its digest. Throws
/// Error(internal) without runs.
std::string make_report(const ReportInput& input);

/// A frame with a low score: its name and the score in words. One object per frame in worst_frames.json, worst first.
struct WorstFrame {
  std::string name, note;
};
std::string worst_frames_json(const std::vector<WorstFrame>& frames);
std::vector<WorstFrame> parse_worst_frames(std::string_view json, const std::string& name);

/// What a report needs, read from run folders: metrics.jsonl, run.yaml, environment.json, left_out.json, labels.json,
/// final_eval.json, labelling.json with the pictures that it names, classes.yaml and the images
/// render/<split>/<frame>_{rgb_truth,rgb,label_truth_vis,label_vis,entropy_vis,depth_vis}.png of the first run: those
/// that its worst_frames.json names, and at most `most_frames` others, evenly chosen. Only metrics.jsonl must be there.
/// Names are the folders', made unique.
ReportInput read_report_input(const std::vector<std::string>& run_folders, int most_frames = 4);

// The report of a run: everything it shows comes from the run folder and the frames rendered last.

/// Writes report.html with its pictures and worst_frames.json into the folder; returns its path. `scene`:
/// ReportInput::scene.
std::string write_run_report(const RunFolder& folder, const Session& session, const ReportFrames& frames,
                             std::string scene = {});

}  // namespace semfield
