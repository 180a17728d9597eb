#include "eval/protocol.h"

#include <fmt/format.h>

#include <algorithm>
#include <cctype>
#include <set>

#include "core/text.h"
#include "scene/classes/class_import.h"
#include "system/checksum.h"

namespace semfield {

namespace {

const std::string kSceneVoid = "pixels whose true class the scene ignores are void";
const std::string kListVoid = "pixels whose true class is none of the list are void";

std::vector<std::string> names_of(const std::string& published) {
  std::vector<std::string> names;
  const ClassTable table = published_classes(published);
  for (int c = 0; c < table.valid_count(); ++c) names.push_back(table.valid(c).name);
  return names;
}

const std::vector<Protocol>& protocols() {
  static const std::vector<Protocol> all{{"semantic_nerf", "Zhi21", {}, kSceneVoid},
                                         {"panoptic_lifting", "Siddiqui23", {}, kSceneVoid},
                                         {"scannet20", "Dai17", names_of("scannet20"), kListVoid},
                                         {"nyu40", "Gupta13", names_of("nyu40"), kListVoid}};
  return all;
}

std::string compared_name(std::string name) {
  for (char& c : name) c = c == '-' || c == '_' ? ' ' : static_cast<char>(std::tolower(static_cast<unsigned char>(c)));
  return name == "refridgerator" ? "refrigerator" : name;  // as ScanNet's table spells it
}

}  // namespace

std::vector<std::string> protocol_names() {
  std::vector<std::string> names;
  for (const Protocol& protocol : protocols()) names.push_back(protocol.name);
  return names;
}

Protocol protocol_named(const std::string& name) {
  for (const Protocol& protocol : protocols())
    if (protocol.name == name) return protocol;
  throw Error(ErrorKind::usage, "eval.protocol.unknown", "unknown protocol '" + name + "'",
              "one of " + join(protocol_names()));
}

ProtocolScore protocol_score(const Protocol& protocol, const ConfusionMatrix& confusion, const ClassTable& classes) {
  std::set<std::string> listed;
  for (const std::string& name : protocol.classes) listed.insert(compared_name(name));
  ProtocolScore out{protocol, {}, {}, 0, {}, {}, {}};
  std::vector<int> counted;
  for (int c = 0; c < classes.valid_count(); ++c) {
    const std::string& name = classes.valid(c).name;
    if (!protocol.classes.empty() && listed.count(compared_name(name)) == 0) {
      out.void_classes.push_back(name);
      continue;
    }
    counted.push_back(c);
    out.classes.push_back({name, 0, {}});
  }
  if (counted.empty())
    throw Error(ErrorKind::data, "eval.protocol.classes",
                fmt::format("no class of the scene is one of {}: {}", protocol.name, join(out.void_classes)),
                "name the classes of the scene's table as `semfield classes " + protocol.name + "` does");
  double iou_sum = 0, recall_sum = 0;
  std::int64_t right = 0;
  int present = 0;
  for (std::size_t k = 0; k < counted.size(); ++k) {
    std::int64_t truth = 0, predicted = 0;
    for (int other = 0; other < classes.valid_count(); ++other) truth += confusion.count(counted[k], other);
    for (const int other : counted) predicted += confusion.count(other, counted[k]);
    const std::int64_t both = confusion.count(counted[k], counted[k]);
    out.classes[k].truth_px = truth;
    if (truth == 0) continue;
    out.classes[k].iou = static_cast<double>(both) / static_cast<double>(truth + predicted - both);
    iou_sum += *out.classes[k].iou;
    recall_sum += static_cast<double>(both) / static_cast<double>(truth);
    out.scored_px += truth;
    right += both;
    ++present;
  }
  if (present == 0) return out;
  out.miou = iou_sum / present;
  out.average_accuracy = recall_sum / present;
  out.total_accuracy = static_cast<double>(right) / static_cast<double>(out.scored_px);
  return out;
}

std::string truth_hash(std::span<const int> frames, const std::vector<FrameInfo>& infos,
                       const std::vector<StoredFrame>& stored, const ClassTable& classes) {
  std::uint32_t crc = 0;
  for (const int f : frames) {
    const FrameInfo& info = infos[static_cast<std::size_t>(f)];
    const std::string head = fmt::format("{}\n{} {}\n", info.name, info.camera.width_px, info.camera.height_px);
    crc = crc32c(std::as_bytes(std::span(head)), crc);
    std::vector<std::int32_t> ids;
    for (const std::int16_t label : stored[static_cast<std::size_t>(f)].label.expand())
      ids.push_back(label == kVoid ? -1 : classes.valid(label).id);
    crc = crc32c(std::as_bytes(std::span(ids)), crc);
  }
  return fmt::format("{:08x}", crc);
}

}  // namespace semfield
