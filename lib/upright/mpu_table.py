# The configuration of a chip as a table of rows: register, value, and the bits that are compared.
# Needs the registers that are handed in. Runs on MicroPython >= 1.22 and under CPython.


class RegisterTable:
    """What is written at set-up and verified, and what a monitor watches and writes back.

    Rows are written in order; the last one starts what the others have configured. registers names each row in
    messages. numbers, values and masks have a byte for each row; numbers[row] is its register.
    """

    def __init__(self, registers):
        self.registers = registers
        self.load([])

    def load(self, rows):
        """Take these rows, (register, value, mask), in place of all others; the chip is left alone."""
        self.numbers = bytes(row[0] for row in rows)
        self.values = bytearray(row[1] for row in rows)
        self.masks = bytes(row[2] for row in rows)

    def rows(self):
        """All rows as a list of (register, value, mask)."""
        return [(self.numbers[i], self.values[i], self.masks[i]) for i in range(len(self.numbers))]

    def apply(self):
        """Write the whole table to the chip, then verify it."""
        for register, value, _ in self.rows():
            self.registers.write_register(register, value)
        for row in self.rows():
            self.registers.verify_register(*row)

    def set(self, register, value):
        """Change the row of a register, on the chip as well, and verify it."""
        row = self.numbers.find(bytes((register,)))
        self.values[row] = value
        self.registers.write_register(register, value)
        self.registers.verify_register(register, value, self.masks[row])

    def merge(self, rows):
        """Change rows in their place and put new ones before the last; then write these rows and verify them."""
        table = self.rows()
        for row in rows:
            at = self.numbers.find(bytes((row[0],)))
            if at < 0:
                at = len(table) - 1
                table.insert(at, row)
            else:
                table[at] = row
            self.load(table)
        for register, value, _ in rows:
            self.registers.write_register(register, value)
        for row in rows:
            self.registers.verify_register(*row)

    # The last row; in the tick too: neither allocates

    def last(self):
        """Its value; 0 while there is no row."""
        n = len(self.values)
        return self.values[n - 1] if n else 0

    def change_last(self, bits, mask):
        """Give its bits of mask the values that they have in bits; the chip is left alone."""
        at = len(self.values) - 1
        self.values[at] = self.values[at] & ~mask | bits & mask
