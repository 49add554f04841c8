while true do
    h3c.dOut(17, h3c.dIn(1)) -- lê o valor da entrada 1 e aplica na saída 17
end
