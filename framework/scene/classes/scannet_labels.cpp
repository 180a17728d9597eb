#include "scene/classes/scannet_labels.h"

#include <algorithm>
#include <optional>

#include "core/error.h"
#include "formats/text_rows.h"

namespace semfield {

namespace {

struct Column {
  std::string_view name;
  std::optional<std::size_t> at;
};

Column column_of(const TextRow& header, std::string_view name) {
  const auto found = std::find(header.fields.begin(), header.fields.end(), name);
  if (found == header.fields.end()) return {name, std::nullopt};
  return {name, static_cast<std::size_t>(found - header.fields.begin())};
}

const std::string& text_at(const TextRow& row, const Column& column) {
  static const std::string none;
  return column.at ? row.fields[*column.at] : none;
}

std::int32_t number_at(const TextRow& row, const Column& column, std::int64_t highest) {
  const std::string& text = text_at(row, column);
  if (text.empty()) return 0;
  std::int64_t value = 0;
  if (!parse_whole(text, value) || value < 0 || value > highest) {
    throw Error(ErrorKind::data, "classes.tsv.damaged",
                row.place + ": " + std::string(column.name) + ": expected a number from 0 to " +
                    std::to_string(highest) + ", got '" + text + "'",
                "restore the table as ScanNet distributes it");
  }
  return static_cast<std::int32_t>(value);
}

template <class Member>
std::unordered_map<std::int32_t, std::int32_t> map_of(const std::vector<ScannetLabel>& labels, Member member) {
  std::unordered_map<std::int32_t, std::int32_t> out;
  for (const ScannetLabel& label : labels) out.emplace(label.id, label.*member);
  return out;
}

}  // namespace

std::vector<ScannetLabel> read_scannet_tsv(const std::string& path) {
  const std::vector<TextRow> rows = read_text_rows(path, '\t');
  const std::string remedy = "give scannetv2-labels.combined.tsv: tab-separated, with a line of column names";
  if (rows.empty()) throw Error(ErrorKind::data, "classes.tsv.damaged", path + ": no rows in it", remedy);
  const TextRow& header = rows.front();
  const Column id = column_of(header, "id"), raw = column_of(header, "raw_category"),
               nyu40 = column_of(header, "nyu40id"), eigen13 = column_of(header, "eigen13id"),
               nyu40_name = column_of(header, "nyu40class"), eigen13_name = column_of(header, "eigen13class");
  for (const Column& needed : {id, raw}) {
    if (!needed.at)
      throw Error(ErrorKind::data, "classes.tsv.damaged",
                  header.place + ": no column '" + std::string(needed.name) + "'", remedy);
  }
  if (!nyu40.at && !eigen13.at)
    throw Error(ErrorKind::data, "classes.tsv.damaged",
                header.place + ": neither a column 'nyu40id' nor a column 'eigen13id'", remedy);

  std::vector<ScannetLabel> labels;
  std::unordered_map<std::int32_t, std::size_t> seen;
  for (std::size_t r = 1; r < rows.size(); ++r) {
    const TextRow& row = rows[r];
    if (row.fields.size() != header.fields.size()) {
      throw Error(ErrorKind::data, "classes.tsv.damaged",
                  row.place + ": " + std::to_string(row.fields.size()) + " columns, the first line names " +
                      std::to_string(header.fields.size()),
                  remedy);
    }
    if (text_at(row, id).empty())
      throw Error(ErrorKind::data, "classes.tsv.damaged", row.place + ": the row has no id", remedy);
    ScannetLabel label{number_at(row, id, 65535),   text_at(row, raw),        number_at(row, nyu40, 40),
                       number_at(row, eigen13, 13), text_at(row, nyu40_name), text_at(row, eigen13_name)};
    const auto [first, fresh] = seen.emplace(label.id, labels.size());
    if (!fresh) {
      const ScannetLabel& other = labels[first->second];
      if (other.nyu40id != label.nyu40id || other.eigen13id != label.eigen13id) {
        throw Error(ErrorKind::data, "classes.id.twice",
                    row.place + ": id " + std::to_string(label.id) + " ('" + label.raw_category +
                        "') is given before ('" + other.raw_category + "') with another class",
                    remedy);
      }
    }
    labels.push_back(std::move(label));
  }
  return labels;
}

std::unordered_map<std::int32_t, std::int32_t> nyu40_of_scannet(const std::vector<ScannetLabel>& labels) {
  return map_of(labels, &ScannetLabel::nyu40id);
}

std::unordered_map<std::int32_t, std::int32_t> eigen13_of_scannet(const std::vector<ScannetLabel>& labels) {
  return map_of(labels, &ScannetLabel::eigen13id);
}

}  // namespace semfield
