#include "studies/leave_out_page.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "studies/page_parts.h"

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

constexpr const char* kPairsStudy = "study pairs";

}  // namespace

std::string saving_text(const PairCost& cost) {
  const std::int64_t bytes = cost.kept_bytes - cost.out_bytes;
  std::string text;
  if (cost.of == "start") {
    text = fmt::format("{} of CPU time at the start", seconds_text(cost.kept_s));
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
    throw Error(ErrorKind::data, "study.result.damaged", "'" + name + "' is no table of leave-out pairs: " + e.what(),
                "delete it, and write it again with `semfield-study pairs --write-docs`");
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

std::string with_findings(std::string page, const LeaveOutFindings& findings, const std::string& name) {
  std::string out = "| component | rule | proof | result | saving, measured | kept by |\n|---|---|---|---|---|---|\n";
  std::string kept =
      "| component | it would be left out when | saving, measured | cost in quality | kept, because |\n"
      "|---|---|---|---|---|\n";
  for (const LeaveOutFinding& row : findings.rows) {
    if (row.but.empty()) {
      out += fmt::format("| `{}` | {} | {}{} | {} | {} | {} |\n", row.name, cell(row.rule), row.proof,
                         row.holds ? "" : ", **does not hold**", cell(row.result), cell(row.saving), cell(row.kept_by));
    } else {
      kept += fmt::format("| `{}` | {} | {} | {} | {} |\n", row.name, cell(row.rule), cell(row.saving),
                          row.result.empty() ? "not measured" : cell(row.result), cell(row.but));
    }
  }
  put_part(page, kPairsStudy, "measured", findings.about + "\n", name);
  put_part(page, kPairsStudy, "left out", out, name);
  put_part(page, kPairsStudy, "kept", kept, name);
  return page;
}

}  // namespace semfield
