#include "eval/final_eval.h"

#include <fmt/format.h>

#include <cmath>
#include <nlohmann/json.hpp>
#include <stdexcept>

#include "core/error.h"
#include "eval/metrics.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

// A million entries of it still sum up in 64 bits.
constexpr std::int64_t kMostPixels = 1'000'000'000'000;

Error unreadable(const std::string& name, const std::string& what) {
  return Error(ErrorKind::data, "run.record.damaged", fmt::format("'{}' cannot be read: {}", name, what),
               "delete it; a report does without");
}

std::int64_t integer_of(const Json& json, std::int64_t low, std::int64_t high) {
  const bool fits = json.is_number_integer() &&
                    !(json.is_number_unsigned() && json.get<std::uint64_t>() > static_cast<std::uint64_t>(high));
  if (!fits || json.get<std::int64_t>() < low || json.get<std::int64_t>() > high)
    throw std::out_of_range(fmt::format("{} is not an integer from {} to {}", json.dump(), low, high));
  return json.get<std::int64_t>();
}

std::int64_t pixels_of(const Json& json) { return integer_of(json, 0, kMostPixels); }

std::int32_t id_of(const Json& json) { return static_cast<std::int32_t>(integer_of(json, 0, 65535)); }

double share_of(const Json& json) {
  const double share = json.is_null() ? 0 : json.get<double>();
  if (!(share >= 0 && share <= 1 + 1e-6)) throw std::out_of_range(fmt::format("{} lies outside 0 to 1", share));
  return share;
}

std::optional<double> score_of(const Json& json) {
  std::optional<double> value;
  if (!read_number_json(json, value)) throw std::out_of_range(json.dump() + " is not a score");
  return value;
}

// Calls read(parsed) and turns every complaint into one that names the file.
template <class Read>
auto parse(std::string_view text, const std::string& name, Read&& read) {
  try {
    return read(Json::parse(text));
  } catch (const nlohmann::json::exception& e) {
    throw unreadable(name, e.what());
  } catch (const std::out_of_range& e) {
    throw unreadable(name, e.what());
  }
}

Json confusion_json(const FinalEval& eval) {
  Json out, rows = Json::array();
  for (std::size_t t = 0; t < eval.classes.size(); ++t) {
    Json row = Json::array();
    for (std::size_t p = 0; p < eval.classes.size(); ++p) row.push_back(eval.count(t, p));
    rows.push_back(std::move(row));
  }
  out["pixels"] = std::move(rows);
  out["void_truth_pixels"] = eval.void_truth_px;
  out["void_predicted_pixels"] = eval.void_predicted_px;
  return out;
}

Json reliability_json(const FinalEval& eval) {
  Json out, bins = Json::array();
  for (const FinalEval::Bin& bin : eval.bins) {
    const auto share = [&](double value) { return bin.pixels > 0 ? Json(value) : Json(nullptr); };
    bins.push_back({{"pixels", bin.pixels}, {"confidence", share(bin.confidence)}, {"accuracy", share(bin.accuracy)}});
  }
  out["bins"] = std::move(bins);
  out["nonfinite_pixels"] = eval.nonfinite_px;
  return out;
}

}  // namespace

std::optional<double> FinalEval::ece() const {
  double sum = 0, pixels = 0;
  for (const Bin& bin : bins) {
    sum += static_cast<double>(bin.pixels) * std::abs(bin.accuracy - bin.confidence);
    pixels += static_cast<double>(bin.pixels);
  }
  return pixels > 0 && nonfinite_px == 0 ? std::optional(sum / pixels) : std::nullopt;
}

FinalEval final_eval(const SplitScore& score, const ClassTable& table, std::string split) {
  FinalEval eval;
  eval.split = std::move(split);
  const std::vector<ClassScore> scores = score.confusion.per_class();
  std::vector<int> present;
  for (int c = 0; c < score.confusion.classes(); ++c) {
    const ClassScore& k = scores[static_cast<std::size_t>(c)];
    if (k.truth_px == 0 && k.predicted_px == 0) continue;
    present.push_back(c);
    const ClassEntry& entry = table.valid(c);
    eval.classes.push_back({entry.id, entry.name, entry.color});
  }
  for (const int truth : present) {
    for (const int predicted : present) eval.confusion.push_back(score.confusion.count(truth, predicted));
  }
  eval.void_truth_px = score.confusion.void_truth_px();
  eval.void_predicted_px = score.confusion.void_predicted_px();
  eval.nonfinite_px = score.calibration.nonfinite();
  if (score.calibration.scored_px() > 0) {
    for (const Calibration::Bin& bin : score.calibration.bins()) {
      const double pixels = bin.pixels > 0 ? static_cast<double>(bin.pixels) : 1;
      eval.bins.push_back({bin.pixels, bin.confidence / pixels, static_cast<double>(bin.correct) / pixels});
    }
  }
  eval.entropy_auroc = score.entropy.detects_wrong();
  eval.resolution = score.resolution;
  eval.frames = score.frames;
  return eval;
}

std::string final_eval_json(const FinalEval& eval) {
  Json out;
  out["split"] = eval.split;
  out["step"] = eval.step;
  out["train_s"] = eval.train_s;
  Json& classes = out["classes"] = Json::array();
  for (const FinalEval::Class& c : eval.classes)
    classes.push_back({{"id", c.id}, {"name", c.name}, {"color", c.color}});
  out["confusion"] = confusion_json(eval);
  out["reliability"] = reliability_json(eval);
  const std::optional<Auroc>& auroc = eval.entropy_auroc;
  out["entropy"] = {{"auroc", auroc ? Json(auroc->value) : Json(nullptr)},
                    {"auroc_error", auroc ? Json(auroc->error) : Json(nullptr)}};
  out["opacity"] = {{"opaque_pixels", eval.resolution.opaque_px},
                    {"under_resolved_pixels", eval.resolution.under_resolved_px}};
  Json& frames = out["per_frame"] = Json::array();
  for (const FrameScore& frame : eval.frames) {
    frames.push_back({{"frame", frame.name},
                      {"psnr", number_json<Json>(frame.psnr_db)},
                      {"miou_present", number_json<Json>(frame.miou_present)},
                      {"absrel", number_json<Json>(frame.absrel)}});
  }
  return out.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

FinalEval parse_final_eval(std::string_view text, const std::string& name) {
  return parse(text, name, [](const Json& json) {
    FinalEval eval;
    eval.split = json.at("split").get<std::string>();
    eval.step = integer_of(json.at("step"), 0, kMostPixels);
    eval.train_s = json.at("train_s").get<double>();
    for (const Json& row : json.at("classes")) {
      FinalEval::Class& c = eval.classes.emplace_back();
      c.id = id_of(row.at("id"));
      c.name = row.at("name").get<std::string>();
      for (std::size_t channel = 0; channel < c.color.size(); ++channel)
        c.color[channel] = static_cast<std::uint8_t>(integer_of(row.at("color").at(channel), 0, 255));
    }
    const Json& confusion = json.at("confusion");
    const Json& rows = confusion.at("pixels");
    const std::size_t classes = eval.classes.size();
    if (!rows.is_array() || rows.size() != classes)
      throw std::out_of_range(fmt::format("the confusion matrix has {} rows for {} classes", rows.size(), classes));
    for (const Json& row : rows) {
      if (!row.is_array() || row.size() != classes)
        throw std::out_of_range(
            fmt::format("a row of the confusion matrix has {} entries for {} classes", row.size(), classes));
      for (const Json& pixels : row) eval.confusion.push_back(pixels_of(pixels));
    }
    eval.void_truth_px = pixels_of(confusion.at("void_truth_pixels"));
    eval.void_predicted_px = pixels_of(confusion.at("void_predicted_pixels"));
    const Json& reliability = json.at("reliability");
    for (const Json& bin : reliability.at("bins")) {
      eval.bins.push_back({pixels_of(bin.at("pixels")), share_of(bin.at("confidence")), share_of(bin.at("accuracy"))});
    }
    eval.nonfinite_px = pixels_of(reliability.at("nonfinite_pixels"));
    if (json.contains("entropy") && !json.at("entropy").at("auroc").is_null())
      eval.entropy_auroc = {share_of(json.at("entropy").at("auroc")), share_of(json.at("entropy").at("auroc_error"))};
    if (json.contains("opacity")) {
      eval.resolution.opaque_px = pixels_of(json.at("opacity").at("opaque_pixels"));
      eval.resolution.under_resolved_px = pixels_of(json.at("opacity").at("under_resolved_pixels"));
    }
    for (const Json& row : json.at("per_frame")) {
      FrameScore& frame = eval.frames.emplace_back();
      frame.name = row.at("frame").get<std::string>();
      frame.psnr_db = score_of(row.at("psnr"));
      frame.miou_present = score_of(row.at("miou_present"));
      frame.absrel = score_of(row.at("absrel"));
    }
    return eval;
  });
}

namespace {

Json rounds_to_json(const std::vector<SelfTrainingRound>& rounds) {
  Json out = Json::array();
  for (const SelfTrainingRound& round : rounds) {
    out.push_back({{"step", round.step},
                   {"unlabelled_pixels", round.unlabelled_px},
                   {"added_pixels", round.added_px},
                   {"scored_pixels", round.scored_px},
                   {"right_pixels", round.right_px},
                   {"accuracy", number_json<Json>(round.accuracy())}});
  }
  return out;
}

std::vector<SelfTrainingRound> rounds_of(const Json& json) {
  std::vector<SelfTrainingRound> rounds;
  for (const Json& row : json) {
    rounds.push_back({pixels_of(row.at("step")), pixels_of(row.at("unlabelled_pixels")),
                      pixels_of(row.at("added_pixels")), pixels_of(row.at("scored_pixels")),
                      pixels_of(row.at("right_pixels"))});
  }
  return rounds;
}

}  // namespace

std::string SelfTrainingRound::text() const {
  const double share = unlabelled_px > 0 ? static_cast<double>(added_px) / static_cast<double>(unlabelled_px) : 0;
  std::string out = fmt::format("self-training at step {}: {} pixels labelled, {:.1f} % of those without a label", step,
                                added_px, 100 * share);
  if (accuracy()) out += fmt::format("; {:.1f} % of them as the scene's own labels say", 100 * *accuracy());
  return out;
}

std::string rounds_json(const std::vector<SelfTrainingRound>& rounds) { return rounds_to_json(rounds).dump(); }

std::vector<SelfTrainingRound> parse_rounds(std::string_view text, const std::string& name) {
  return parse(text, name, rounds_of);
}

LabelCounts label_counts(const SceneManifest& manifest, const ClassTable& table,
                         std::vector<TrainingLabels::Step> steps) {
  LabelCounts counts;
  counts.steps = std::move(steps);
  counts.train_frames = manifest.train_frames;
  counts.labelled_frames = manifest.labelled_frames;
  counts.train_px = manifest.train_pixels;
  for (std::size_t c = 0; c < manifest.train_class_pixels.size(); ++c) {
    const ClassEntry& entry = table.valid(static_cast<int>(c));
    counts.classes.push_back({entry.id, entry.name, manifest.train_class_pixels[c]});
    counts.labelled_px += manifest.train_class_pixels[c];
  }
  return counts;
}

std::string label_counts_json(const LabelCounts& counts) {
  Json out;
  out["train_frames"] = counts.train_frames;
  out["labelled_frames"] = counts.labelled_frames;
  out["train_pixels"] = counts.train_px;
  out["labelled_pixels"] = counts.labelled_px;
  Json& classes = out["classes"] = Json::array();
  for (const LabelCounts::Class& c : counts.classes)
    classes.push_back({{"id", c.id}, {"name", c.name}, {"pixels", c.pixels}});
  Json& steps = out["degrade"] = Json::array();
  for (const TrainingLabels::Step& step : counts.steps) {
    Json facts = Json::object();
    for (const auto& [name, value] : step.facts) facts[name] = value;
    steps.push_back({{"type", step.type}, {"facts", std::move(facts)}});
  }
  if (!counts.rounds.empty()) out["self_training"] = rounds_to_json(counts.rounds);
  return out.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

LabelCounts parse_label_counts(std::string_view text, const std::string& name) {
  return parse(text, name, [](const Json& json) {
    LabelCounts counts;
    counts.train_frames = pixels_of(json.at("train_frames"));
    counts.labelled_frames = pixels_of(json.at("labelled_frames"));
    counts.train_px = pixels_of(json.at("train_pixels"));
    counts.labelled_px = pixels_of(json.at("labelled_pixels"));
    for (const Json& row : json.at("classes")) {
      counts.classes.push_back({id_of(row.at("id")), row.at("name").get<std::string>(), pixels_of(row.at("pixels"))});
    }
    for (const Json& row : json.value("degrade", Json::array())) {
      TrainingLabels::Step& step = counts.steps.emplace_back();
      step.type = row.at("type").get<std::string>();
      for (const auto& [fact, value] : row.at("facts").items()) step.facts.emplace_back(fact, value.get<std::string>());
    }
    counts.rounds = rounds_of(json.value("self_training", Json::array()));
    return counts;
  });
}

}  // namespace semfield
