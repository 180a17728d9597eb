// report.html: one self-contained page about one or several runs; the same input gives the same bytes. What it shows is
// JSON in it, which page/report.js draws when the page is opened. Also pieces of pages that stand alone.
#pragma once

#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "train/run_folder.h"
#include "train/run_scores.h"
#include "train/session.h"

namespace semfield {

/// What a report shows, as JSON, read from run folders: metrics.jsonl, run.yaml, environment.json, left_out.json,
/// labels.json, final_eval.json, labelling.json with the pictures that it names, classes.yaml and the images
/// render/<split>/<frame>_{rgb_truth,rgb,label_truth_vis,label_vis,entropy_vis,depth_vis}.png of the first run: those
/// that its worst_frames.json names, and at most `most_frames` others, evenly chosen. Only metrics.jsonl must be there.
/// Names are the folders', made unique. Throws Error(data) naming a damaged file.
std::string read_report(const std::vector<std::string>& run_folders, int most_frames = 4);

/// The page around the JSON of read_report, or of a sweep ("title" and "experiments"): no network, images inside, and
/// no script but its own and that of `scene`, each named by its digest. `scene`: a page that stands alone and shows the
/// first run in 3D; may be empty.
std::string report_page(std::string_view json, const std::string& scene = {});

/// Writes report.html with its pictures and worst_frames.json into the folder of a run, from the frames rendered last;
/// returns its path.
std::string write_run_report(const RunFolder& folder, const Session& session, const ReportFrames& frames,
                             const std::string& scene = {});

// Pieces of HTML pages that stand alone.

/// Text made safe for element content and quoted attributes: & < > " ' are escaped, control characters become U+FFFD.
std::string html_escape(std::string_view text);

/// Standard base64 with padding [RFC4648, Sec. 4].
std::string base64(std::span<const std::uint8_t> bytes);

/// JSON for a script element: nothing in it may end the element.
std::string script_json(std::string json);

/// `page` with every place of `parts` filled; what fills one is not looked at again, whatever it holds. Throws
/// Error(no_input) where a place is missing.
std::string filled_page(const std::string& page, std::map<std::string, std::string> parts);

}  // namespace semfield
