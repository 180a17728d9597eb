// The file of golden values: a section for each compiler and C library, in it a row a configuration and a column an
// instruction set.
#pragma once

#include <map>
#include <string>
#include <vector>

namespace semfield::testing_golden {

/// configuration -> checksum, in the order of the rows.
using Column = std::vector<std::pair<std::string, std::string>>;
/// column_name -> its column.
using Section = std::map<std::string, Column>;

/// What the values depend on beside the instruction set: "gcc 12, glibc 2.36".
std::string toolchain();

/// The column of an instruction set on this processor.
std::string column_name(const std::string& isa);

/// toolchain -> its section. Throws Error(data) naming file and line.
std::map<std::string, Section> read_golden_file(const std::string& path);
/// Columns of a section have the same rows.
void write_golden_file(const std::string& path, const std::map<std::string, Section>& sections);

/// What golden_rows printed.
Column parse_column(const std::string& text);

}  // namespace semfield::testing_golden
