#include "labels/labelling_record.h"

#include <exception>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "formats/text_rows.h"

namespace semfield {

std::string labelling_record_json(const LabellingRecord& record) {
  using Json = nlohmann::ordered_json;
  Json classes = Json::array(), shown = Json::array();
  for (const LabellingRecord::Class& c : record.classes)
    classes.push_back({{"id", c.id},
                       {"name", c.name},
                       {"color", c.color},
                       {"clicks", c.clicks},
                       {"area_share", c.area_share},
                       {"confidence", c.confidence}});
  for (const LabellingRecord::Frame& f : record.shown) shown.push_back({{"frame", f.name}, {"clicks", f.clicks}});
  return Json{{"step", record.step},     {"clicks", record.clicks},       {"clicked_frames", record.clicked_frames},
              {"frames", record.frames}, {"classes", std::move(classes)}, {"shown", std::move(shown)}}
             .dump(2, ' ', false, Json::error_handler_t::replace) +
         "\n";
}

namespace {

LabellingRecord record_of(const nlohmann::json& root) {
  LabellingRecord record;
  read_json_value(root, "step", record.step);
  read_json_value(root, "clicks", record.clicks);
  read_json_value(root, "clicked_frames", record.clicked_frames);
  read_json_value(root, "frames", record.frames);
  for (const nlohmann::json& from : root.at("classes")) {
    LabellingRecord::Class& c = record.classes.emplace_back();
    read_json_value(from, "id", c.id);
    read_json_value(from, "name", c.name);
    read_json_value(from, "color", c.color);
    read_json_value(from, "clicks", c.clicks);
    read_json_value(from, "area_share", c.area_share);
    read_json_value(from, "confidence", c.confidence);
  }
  for (const nlohmann::json& from : root.at("shown")) {
    LabellingRecord::Frame& f = record.shown.emplace_back();
    read_json_value(from, "frame", f.name);
    read_json_value(from, "clicks", f.clicks);
  }
  return record;
}

}  // namespace

LabellingRecord parse_labelling_record(std::string_view json, const std::string& name) {
  try {
    return record_of(nlohmann::json::parse(json));
  } catch (const std::exception& e) {  // of the JSON, or out of range
    throw Error(ErrorKind::data, "run.record.damaged", "'" + name + "' cannot be read: " + e.what(),
                "delete it; the labelling page writes it again");
  }
}

}  // namespace semfield
