#include "studies/leave_out_page.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>

#include "core/error.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

constexpr std::array<std::pair<const char*, std::string LeaveOutFinding::*>, 8> kTexts{{
    {"name", &LeaveOutFinding::name},
    {"component", &LeaveOutFinding::component},
    {"rule", &LeaveOutFinding::rule},
    {"proof", &LeaveOutFinding::proof},
    {"kept_by", &LeaveOutFinding::kept_by},
    {"but", &LeaveOutFinding::but},
    {"result", &LeaveOutFinding::result},
    {"saving_measured", &LeaveOutFinding::saving},
}};

std::string seconds_text(double s) {
  if (s < 1e-3) return fmt::format("{:.3g} µs", 1e6 * s);
  return s < 1 ? fmt::format("{:.3g} ms", 1e3 * s) : fmt::format("{:.3g} s", s);
}

std::string cell(std::string text) {
  for (std::size_t at = 0; (at = text.find('|', at)) != std::string::npos; at += 2) text.insert(at, "\\");
  return text;
}

// Components that other software of this kind has, and this has not: nothing to leave out.
constexpr const char* kNotThere =
    "There is nothing to leave out of a background or environment model, appearance and exposure codes, pose "
    "refinement,\nloss scaling, an anomaly detector and a server: this software has none. Decisions that are settings "
    "and not findings\n(`density_noise`, `mixed_precision`, `cuda`, `matrix_library`, `depth_metrics`) stand in every "
    "run's list without a pair.\n";

constexpr const char* kConsidered =
    "**Considered and kept.** Two colour channels of a grey scene: the colour layer's two further columns are 128 of "
    "the\n8,000 multiply-adds of a sample of the small network (1.6 %), 256 of 593,408 of the deep one, for a field "
    "with another\noutput. Semantic samples of tiny weight, when rendering: the whole head, class layer included, is "
    "what `semantic_outputs` "
    "saves;\nits hidden layer is the part that could be skipped, and finding out which samples may be skipped costs a "
    "norm and two copies of each "
    "sample's\nfeature.\n";

}  // namespace

std::string saving_text(const PairCost& cost) {
  const std::int64_t bytes = cost.kept_bytes - cost.out_bytes;
  std::string text;
  if (cost.of == "start") {
    text = fmt::format("{} of processor time at the start", seconds_text(cost.kept_s));
  } else if (std::abs(cost.share) <= cost.noise) {
    text = fmt::format("no more than its noise: {:+.1f} ± {:.1f} % of a {} ({})", 100 * cost.share, 100 * cost.noise,
                       cost.of, seconds_text(cost.out_s));
  } else {
    text = fmt::format("{}{:.1f} ± {:.1f} % of a {} ({} against {})", cost.share < 0 ? "none, it costs " : "",
                       100 * std::abs(cost.share), 100 * cost.noise, cost.of, seconds_text(cost.out_s),
                       seconds_text(cost.kept_s));
  }
  if (bytes >= 50000) text += fmt::format(", {:.1f} MB", 1e-6 * static_cast<double>(bytes));
  return text;
}

LeaveOutFinding finding_of(const LeaveOutPair& pair, const PairResult& result) {
  LeaveOutFinding f;
  f.name = pair.name;
  f.component = pair.component;
  f.rule = pair.rule;
  f.proof = std::string(1, static_cast<char>(pair.proof));
  f.kept_by = pair.kept_by;
  f.but = pair.but;
  f.holds = result.holds;
  f.result = result.result;
  f.saving = saving_text(result.cost);
  return f;
}

std::string findings_json(const LeaveOutFindings& findings) {
  Json json = {{"about", findings.about}, {"rows", Json::array()}};
  for (const LeaveOutFinding& row : findings.rows) {
    Json& object = json["rows"].emplace_back(Json::object());
    for (const auto& [name, field] : kTexts) object[name] = row.*field;
    object["holds"] = row.holds;
  }
  return json.dump(2) + "\n";
}

LeaveOutFindings parse_findings(const std::string& text, const std::string& name) {
  LeaveOutFindings findings;
  try {
    const Json json = Json::parse(text);
    json.at("about").get_to(findings.about);
    for (const Json& object : json.at("rows")) {
      LeaveOutFinding row;
      for (const auto& [key, field] : kTexts) object.at(key).get_to(row.*field);
      object.at("holds").get_to(row.holds);
      findings.rows.push_back(std::move(row));
    }
  } catch (const nlohmann::json::exception& e) {
    throw Error(ErrorKind::data, "'" + name + "' is no table of leave-out pairs: " + e.what(),
                "delete it, and write it anew with `semfield bench pairs --write-docs`");
  }
  return findings;
}

LeaveOutFindings merged(const LeaveOutFindings& old, const LeaveOutFindings& fresh) {
  LeaveOutFindings all;
  all.about = fresh.about;
  for (const LeaveOutPair& pair : leave_out_pairs()) {
    for (const LeaveOutFindings* from : {&fresh, &old}) {
      const auto row = std::find_if(from->rows.begin(), from->rows.end(),
                                    [&](const LeaveOutFinding& r) { return r.name == pair.name; });
      if (row == from->rows.end()) continue;
      all.rows.push_back(*row);
      break;
    }
  }
  return all;
}

std::string findings_markdown(const LeaveOutFindings& findings) {
  std::string out =
      "# Same error, less time\n\n"
      "<!-- Written by `semfield bench pairs --write-docs docs/reference`; not by hand. -->\n\n"
      "What a scene does not need is not built. Each line is a pair of runs of the shipped room, one with the "
      "component "
      "and\none without, and the proof that nothing was lost:\n\n"
      "- **B**, bitwise: SHA-256 of every tensor that both have with its moments, or of the pictures, is the same;\n"
      "- **C**, certified: the run knows a bound, and the measured difference is below it;\n"
      "- **S**, statistical: the 95 % interval of the mean paired difference over seeds lies above -0.1 dB PSNR and "
      "-0.5 "
      "points\n  of mIoU.\n\n"
      "Times are processor seconds of one thread, medians of alternating rounds with half their middle half as noise; "
      "bytes are\nthose of scene, parameters and activations. A run's own list, with the evidence found in its scene, "
      "is "
      "`left_out.json` and\na section of its report.\n\n";
  out += findings.about + "\n\n## Left out\n\n";
  out += "| component | rule | proof | result | saving, measured | kept by |\n|---|---|---|---|---|---|\n";
  for (const LeaveOutFinding& row : findings.rows) {
    if (!row.but.empty()) continue;
    out += fmt::format("| `{}` | {} | {}{} | {} | {} | {} |\n", row.name, cell(row.rule), row.proof,
                       row.holds ? "" : ", **does not hold**", cell(row.result), cell(row.saving), cell(row.kept_by));
  }
  out +=
      "\n## Kept, because\n\n| component | it would be left out when | saving, measured | cost in quality | kept, "
      "because |\n"
      "|---|---|---|---|---|\n";
  for (const LeaveOutFinding& row : findings.rows) {
    if (row.but.empty()) continue;
    out += fmt::format("| `{}` | {} | {} | {} | {} |\n", row.name, cell(row.rule), cell(row.saving),
                       row.result.empty() ? "not measured" : cell(row.result), cell(row.but));
  }
  out += "\n";
  out += kConsidered;
  out += "\n## Not there\n\n";
  out += kNotThere;
  return out;
}

}  // namespace semfield
