// Class probabilities of a network, as NumPy arrays: one .npz or .npy file a frame.
#include "formats/npz.h"

#include <fmt/format.h>

#include <algorithm>
#include <nlohmann/json.hpp>

#include "core/files.h"
#include "core/text.h"
#include "formats/text_rows.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "plugin/module.h"

namespace semfield {

namespace {

using Json = nlohmann::json;

const char* kOrderRemedy = "write a list of the class names in the order of the array's last axis";

// Names by column from {"chair": 0, ...} or {"0": "chair", ...}.
std::vector<std::string> names_of_map(const Json& root, const std::string& path) {
  std::map<std::int64_t, std::string> names;
  for (const auto& [key, value] : root.items()) {
    std::int64_t column = -1;
    std::string name = key;
    if (value.is_number_integer()) {
      column = value.get<std::int64_t>();
    } else if (value.is_string() && !key.empty() && std::all_of(key.begin(), key.end(), ::isdigit) && key.size() < 6) {
      column = std::stoi(key);
      name = value.get<std::string>();
    }
    if (column < 0)
      refuse_labels("labels.order.format", path,
                    "'" + key + "' is neither a name with a column nor a column with a name", kOrderRemedy);
    if (!names.emplace(column, name).second)
      refuse_labels("labels.order.format", path, "column " + std::to_string(column) + " is given twice", kOrderRemedy);
  }
  std::vector<std::string> out;
  for (auto& [column, name] : names) {
    if (column != std::ssize(out))
      refuse_labels("labels.order.format", path, "no class for column " + std::to_string(out.size()), kOrderRemedy);
    out.push_back(std::move(name));
  }
  return out;
}

std::vector<std::string> read_class_order(const std::string& path) {
  Json root;
  try {
    root = Json::parse(read_text_file(path, std::size_t{16} << 20));
  } catch (const Json::exception& e) {
    refuse_labels("labels.order.format", path, "not valid JSON: " + json_cause(e.what()), kOrderRemedy);
  }
  std::vector<std::string> names;
  if (root.is_object()) names = names_of_map(root, path);
  for (const Json& item : root.is_array() ? root : Json::array()) {
    if (!item.is_string())
      refuse_labels("labels.order.format", path, fmt::format("entry {} is not text", names.size() + 1), kOrderRemedy);
    names.push_back(item.get<std::string>());
  }
  if (names.empty()) refuse_labels("labels.order.format", path, "no class names in it", kOrderRemedy);
  std::vector<std::string> sorted = names;
  std::sort(sorted.begin(), sorted.end());
  if (const auto twice = std::adjacent_find(sorted.begin(), sorted.end()); twice != sorted.end())
    refuse_labels("labels.order.format", path, "class '" + *twice + "' is named twice", kOrderRemedy);
  return names;
}

class NpzReader : public LabelReader {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, folder, "folder of the arrays");
    SEMFIELD_PARAM(visit, *this, pattern, "file of a frame, .npz or .npy: {name}, {stem} and {number} as for images");
    SEMFIELD_PARAM(visit, *this, key,
                   "array of the archive: probabilities [height, width, classes], float16 to float64, or uint8 where "
                   "255 is 1; those of a pixel need not add up to 1");
    SEMFIELD_PARAM(visit, *this, classes,
                   "JSON file of class names in the order of the last axis; empty: classes.json in the folder");
    SEMFIELD_PARAM(visit, *this, confidence_key,
                   "array [height, width] of the same archive by which the probabilities are multiplied; empty: none");
  }

  void validate(Diagnostics& diagnostics) const override {
    check_pattern(pattern, diagnostics);
    if (key.empty())
      diagnostics.error("config.value.missing", "key", "no array is named", "write for example key: probability");
    if (!confidence_key.empty() && is_npy())
      diagnostics.error("config.value.conflict", "confidence_key", "a .npy file holds one array",
                        "save both arrays in one .npz file");
  }

  ClassTable open(const ClassTable& known, Diagnostics& diagnostics) override {
    order_.clear();
    files_.clear();
    if (!check_folder(folder, pattern, diagnostics)) return {};
    order_path_ = classes.empty() ? (fs::path(folder) / "classes.json").string() : classes;
    ProblemList problems(diagnostics);
    problems.collect([&] { order_ = read_class_order(order_path_); });
    if (problems.count() > 0) return known;
    if (known.empty()) {
      ClassTable built;
      problems.collect([&] { built = table_of_names(order_); });
      return built;
    }
    const ClassNames names(known);
    for (const std::string& name : order_) problems.collect([&] { (void)names.index_of(name, order_path_); });
    return known;
  }

  void match(const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) override {
    files_.match(folder, pattern, frames, diagnostics);
  }

  bool has(const FrameInfo& frame) const override { return files_.has(frame); }

  LabelRaster read(const FrameInfo& shown, const ClassTable& table) const override {
    const FramesFiles::File found = files_.of(shown, "array");
    const std::string& path = found.path;
    const auto accept = [&](std::span<const std::int64_t> shape) {
      if (shape.size() != 3)
        throw Error(ErrorKind::data, "labels.array.shape", "the shape is " + shape_text(shape),
                    "save an array [height, width, classes]");
      if (shape[2] != std::ssize(order_))
        throw Error(ErrorKind::data, "labels.array.classes",
                    fmt::format("{} classes, '{}' names {}", shape[2], order_path_, order_.size()),
                    "name every class of the last axis, in its order");
      check_image_limits(shape[1], shape[0]);
      check_label_shape(shape[1], shape[0], found.frame.camera);
    };
    const NumpyArray probability = is_npy() ? read_npy(path, accept) : NpzFile(path).read(key, accept);
    NumpyArray confidence;
    if (!confidence_key.empty())
      confidence = NpzFile(path).read(confidence_key, [&](std::span<const std::int64_t> shape) {
        if (shape.size() == 2 && shape[0] == probability.shape[0] && shape[1] == probability.shape[1]) return;
        throw Error(ErrorKind::data, "labels.array.shape",
                    "the shape is " + shape_text(shape) + ", that of '" + key + "' " + shape_text(probability.shape),
                    "save a confidence [height, width]");
      });
    LabelRaster raster = soft_raster(probability, confidence.values, path, table);
    raster.as_stored = found.as_stored;
    return raster;
  }

  std::string folder, pattern = "{name}.npz", key = "probability", classes, confidence_key;

 private:
  bool is_npy() const { return pattern.size() > 4 && pattern.ends_with(".npy"); }

  LabelRaster soft_raster(const NumpyArray& probability, const std::vector<float>& confidence, const std::string& path,
                          const ClassTable& table) const {
    LabelRaster raster{
        static_cast<std::int32_t>(probability.shape[1]), static_cast<std::int32_t>(probability.shape[0]), {}, {}};
    const ClassNames names(table);
    std::vector<std::int16_t> index;
    for (const std::string& name : order_) index.push_back(names.index_of(name, order_path_));
    const std::size_t in = order_.size(), out = static_cast<std::size_t>(table.valid_count());
    const std::size_t pixels = probability.values.size() / in;
    raster.soft.resize(pixels * out);
    // Rounding of the stored values may lift a sum over 1: half a step of 1/255 a class, or the digits of float16.
    const float most = 1.01F + (probability.from_bytes ? 0.5F / 255.0F * static_cast<float>(in) : 0.0F);
    for (std::size_t p = 0; p < pixels; ++p) {
      const float scale = confidence.empty() ? 1.0F : confidence[p];
      float sum = 0;
      for (std::size_t c = 0; c < in; ++c) {
        const float value = probability.values[p * in + c] * scale;
        if (!(value >= 0))
          refuse_pixel(path, p, raster.width_px, "class '" + order_[c] + "' has " + std::to_string(value));
        sum += value;
        if (index[c] >= 0) raster.soft[p * out + static_cast<std::size_t>(index[c])] = value;
      }
      if (!(sum <= most)) refuse_pixel(path, p, raster.width_px, "the classes add up to " + std::to_string(sum));
    }
    return raster;
  }

  [[noreturn]] static void refuse_pixel(const std::string& path, std::size_t pixel, std::int32_t width,
                                        const std::string& what) {
    const auto w = static_cast<std::size_t>(width);
    refuse_labels("labels.probability.invalid", "'" + path + "'",
                  fmt::format("pixel x {}, y {}: {}", pixel % w, pixel / w, what),
                  "save probabilities (after softmax): not negative, in all at most 1");
  }

  std::vector<std::string> order_;  // class names by column
  std::string order_path_;
  FramesFiles files_;
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(npz, "1.0", [](Registry& registry) {
  registry.add_label_reader<NpzReader>("npz", "class probabilities of NumPy arrays: soft labels");
})

}  // namespace semfield
