#include "eval/final_eval.h"

#include <fmt/format.h>

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

void check_share(const Json& json) {
  const double share = json.is_null() ? 0 : json.get<double>();
  if (!(share >= 0 && share <= 1 + 1e-6)) throw std::out_of_range(fmt::format("{} lies outside 0 to 1", share));
}

void check_score(const Json& json) {
  std::optional<double> value;
  if (!read_number_json(json, value)) throw std::out_of_range(json.dump() + " is not a score");
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

}  // namespace

std::string final_eval_json(const SplitScore& score, const ClassTable& table, const std::string& split,
                            std::int64_t step, double train_s) {
  Json out{{"split", split}, {"step", step}, {"train_s", train_s}, {"classes", Json::array()}};
  const std::vector<ClassScore> scores = score.confusion.per_class();
  std::vector<int> present;
  for (int c = 0; c < score.confusion.classes(); ++c) {
    const ClassScore& k = scores[static_cast<std::size_t>(c)];
    if (k.truth_px == 0 && k.predicted_px == 0) continue;
    present.push_back(c);
    const ClassEntry& entry = table.valid(c);
    out["classes"].push_back({{"id", entry.id}, {"name", entry.name}, {"color", entry.color}});
  }
  Json rows = Json::array(), bins = Json::array(), frames = Json::array();
  for (const int truth : present) {
    Json& row = rows.emplace_back(Json::array());
    for (const int predicted : present) row.push_back(score.confusion.count(truth, predicted));
  }
  out["confusion"] = {{"pixels", std::move(rows)},
                      {"void_truth_pixels", score.confusion.void_truth_px()},
                      {"void_predicted_pixels", score.confusion.void_predicted_px()}};
  if (score.calibration.scored_px() > 0)
    for (const Calibration::Bin& bin : score.calibration.bins()) {
      const auto mean = [&](double sum) {
        return bin.pixels > 0 ? Json(sum / static_cast<double>(bin.pixels)) : Json(nullptr);
      };
      bins.push_back({{"pixels", bin.pixels},
                      {"confidence", mean(bin.confidence)},
                      {"accuracy", mean(static_cast<double>(bin.correct))}});
    }
  out["reliability"] = {{"bins", std::move(bins)}, {"nonfinite_pixels", score.calibration.nonfinite()}};
  const std::optional<Auroc> auroc = score.entropy.detects_wrong();
  out["entropy"] = {{"auroc", auroc ? Json(auroc->value) : Json(nullptr)},
                    {"auroc_error", auroc ? Json(auroc->error) : Json(nullptr)}};
  out["opacity"] = {{"opaque_pixels", score.resolution.opaque_px},
                    {"under_resolved_pixels", score.resolution.under_resolved_px}};
  for (const FrameScore& frame : score.frames) {
    frames.push_back({{"frame", frame.name},
                      {"psnr", number_json<Json>(frame.psnr_db)},
                      {"miou_present", number_json<Json>(frame.miou_present)},
                      {"absrel", number_json<Json>(frame.absrel)}});
  }
  out["per_frame"] = std::move(frames);
  return out.dump(-1, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::int64_t check_final_eval(std::string_view text, const std::string& name) {
  return parse(text, name, [](const Json& json) {
    (void)json.at("split").get<std::string>();
    (void)json.at("train_s").get<double>();
    const Json &classes = json.at("classes"), &confusion = json.at("confusion"), &rows = confusion.at("pixels");
    for (const Json& row : classes) {
      (void)id_of(row.at("id"));
      (void)row.at("name").get<std::string>();
      for (std::size_t channel = 0; channel < 3; ++channel) (void)integer_of(row.at("color").at(channel), 0, 255);
    }
    if (!rows.is_array() || rows.size() != classes.size())
      throw std::out_of_range(
          fmt::format("the confusion matrix has {} rows for {} classes", rows.size(), classes.size()));
    for (const Json& row : rows) {
      if (!row.is_array() || row.size() != classes.size())
        throw std::out_of_range(
            fmt::format("a row of the confusion matrix has {} entries for {} classes", row.size(), classes.size()));
      for (const Json& pixels : row) (void)pixels_of(pixels);
    }
    for (const char* what : {"void_truth_pixels", "void_predicted_pixels"}) (void)pixels_of(confusion.at(what));
    const Json& reliability = json.at("reliability");
    for (const Json& bin : reliability.at("bins")) {
      (void)pixels_of(bin.at("pixels"));
      for (const char* what : {"confidence", "accuracy"}) check_share(bin.at(what));
    }
    (void)pixels_of(reliability.at("nonfinite_pixels"));
    // Versions before did not count these.
    if (json.contains("entropy"))
      for (const char* what : {"auroc", "auroc_error"}) check_share(json.at("entropy").at(what));
    if (json.contains("opacity"))
      for (const char* what : {"opaque_pixels", "under_resolved_pixels"}) (void)pixels_of(json.at("opacity").at(what));
    for (const Json& row : json.at("per_frame")) {
      (void)row.at("frame").get<std::string>();
      for (const char* what : {"psnr", "miou_present", "absrel"}) check_score(row.at(what));
    }
    return integer_of(json.at("step"), 0, kMostPixels);
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

std::string label_counts_json(const SceneManifest& manifest, const ClassTable& table,
                              const std::vector<TrainingLabels::Step>& steps,
                              const std::vector<SelfTrainingRound>& rounds) {
  Json classes = Json::array(), done = Json::array();
  std::int64_t labelled_px = 0;
  for (std::size_t c = 0; c < manifest.train_class_pixels.size(); ++c) {
    const ClassEntry& entry = table.valid(static_cast<int>(c));
    classes.push_back({{"id", entry.id}, {"name", entry.name}, {"pixels", manifest.train_class_pixels[c]}});
    labelled_px += manifest.train_class_pixels[c];
  }
  for (const TrainingLabels::Step& step : steps) {
    Json facts = Json::object();
    for (const auto& [name, value] : step.facts) facts[name] = value;
    done.push_back({{"type", step.type}, {"facts", std::move(facts)}});
  }
  Json out{{"train_frames", manifest.train_frames}, {"labelled_frames", manifest.labelled_frames},
           {"train_pixels", manifest.train_pixels}, {"labelled_pixels", labelled_px},
           {"classes", std::move(classes)},         {"degrade", std::move(done)}};
  if (!rounds.empty()) out["self_training"] = rounds_to_json(rounds);
  return out.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::vector<SelfTrainingRound> check_label_counts(std::string_view text, const std::string& name) {
  return parse(text, name, [](const Json& json) {
    for (const char* what : {"train_frames", "labelled_frames", "train_pixels", "labelled_pixels"})
      (void)pixels_of(json.at(what));
    for (const Json& row : json.at("classes")) {
      (void)id_of(row.at("id"));
      (void)row.at("name").get<std::string>();
      (void)pixels_of(row.at("pixels"));
    }
    for (const Json& row : json.at("degrade")) {
      (void)row.at("type").get<std::string>();
      for (const auto& [fact, value] : row.at("facts").items()) (void)value.get<std::string>();
    }
    return rounds_of(json.value("self_training", Json::array()));
  });
}

}  // namespace semfield
